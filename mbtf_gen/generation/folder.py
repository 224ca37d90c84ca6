"""The output folder of a data set: created, resumed, replaced, or refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mbtf_core.config.settings import differences
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.documents import read_manifest, repair_hint
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.geometry import Geometry, encode_geometry, geometry_record
from mbtf_core.data.schema import CONFIG_NAME, FORMAT_NAME, GEOMETRY_NAME, MANIFEST_NAME, SCHEMA_VERSION
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import checksummed
from mbtf_core.files.folders import (
    ELSEWHERE,
    check_folder,
    make_folder,
    other_configuration,
    remove_unfinished,
)
from mbtf_core.locks import brief_lock
from mbtf_gen.generation.geometry import geometry_of
from mbtf_gen.generation.manifest import build_manifest, stored_plan
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import RunPlan


def has_dataset(folder: str | Path | DataFolder, config_hash: str) -> bool:
    """Whether a folder contains a data set of this configuration, finished or not."""
    found = folder if isinstance(folder, DataFolder) else DataFolder.open(folder)
    if not found.has(MANIFEST_NAME):
        return False
    return found.read_json(MANIFEST_NAME, repair_hint(found)).get("config_hash") == config_hash


def holds_dataset(folder: DataFolder) -> bool:
    """Whether an output folder contains a data set; an InputError if it contains something else."""
    if folder.local is not None:
        return check_folder(folder.local, lambda path: (path / MANIFEST_NAME).exists(), "data set")
    if folder.names() and not folder.has(MANIFEST_NAME):
        raise InputError("is not empty and holds no data set", where=folder, hint=ELSEWHERE)
    return folder.has(MANIFEST_NAME)


def open_folder(job: Job, folder: DataFolder, plan: Callable[[Job], RunPlan], overwrite: bool) -> None:
    """Create, resume or replace a job's data set in a folder.

    If several writers start a data set at once, one writes the manifest and the others adopt it.

    Parameters
    ----------
    plan : plans the run; called only if a manifest is to be written

    Raises
    ------
    InputError : the folder contains something else, or a corrupt manifest
    PartialError : it cannot be written, or other processes write the data set that is to be replaced
    """
    if folder.exists() and not folder.has(MANIFEST_NAME) and folder.sidecars():
        raise InputError(f"no {MANIFEST_NAME} in it", where=folder, hint=repair_hint(folder))
    present = holds_dataset(folder)
    replace = overwrite and present
    if replace:
        _check_format(folder)
    elif present:
        _check_same(job, folder)
        if folder.has(CONFIG_NAME) and (job.material.grid is None or folder.has(GEOMETRY_NAME)):
            return
    # Planning takes long: it comes before any change, and outside the lock.
    content = b""
    if replace or not folder.has(MANIFEST_NAME):
        new = plan(job)
        geometry = geometry_of(job, new.effects)
        content = checksummed(build_manifest(job, new, geometry_record(geometry)))
    else:
        geometry = geometry_of(job, read_run_plan(folder).effects)
    if replace:
        folder.clear()
    make_folder(folder.workspace)
    with brief_lock(folder.workspace / MANIFEST_NAME):
        remove_unfinished(folder.workspace, (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME))
        # The manifest comes first: it marks the folder as a data set, at whatever instant the run is killed.
        adopted = bool(content) and not folder.write(MANIFEST_NAME, content, new=True)
        if adopted:
            folder.refresh()
            _check_same(job, folder)
        manifest = read_manifest(folder)
        if not folder.has(CONFIG_NAME):
            folder.write(CONFIG_NAME, dump_yaml(manifest["config"]).encode())
        if geometry is not None and not folder.has(GEOMETRY_NAME):
            if adopted:
                # The plan of the other writer may simulate other effects.
                geometry = geometry_of(job, read_run_plan(folder).effects)
            assert geometry is not None
            check_geometry(folder, geometry, manifest)
            folder.write(GEOMETRY_NAME, encode_geometry(geometry))


def read_run_plan(folder: str | Path | DataFolder) -> RunPlan:
    """The run plan in a data set's manifest; an InputError where that is corrupt."""
    found = folder if isinstance(folder, DataFolder) else DataFolder.open(folder)
    return stored_plan(read_manifest(found), found.at(MANIFEST_NAME))


def check_geometry(folder: DataFolder, geometry: Geometry, manifest: Mapping[str, Any]) -> None:
    """An InputError unless a geometry is the one whose digest a manifest contains."""
    record = geometry_record(geometry)
    if record is None or record["sha256"] != manifest["geometry"]["sha256"]:
        raise InputError(
            "cannot be restored: this machine computes it differently",
            where=folder.at(GEOMETRY_NAME),
            hint="repair it on the machine that generated it, or generate the data set again",
        )


def _check_format(folder: DataFolder) -> dict[str, Any]:
    manifest = folder.read_json(MANIFEST_NAME, repair_hint(folder))
    if manifest.get("format") != FORMAT_NAME:
        what = f"is not a manifest of {FORMAT_NAME}"
        raise InputError(what, where=folder.at(MANIFEST_NAME), hint=ELSEWHERE)
    return manifest


def _check_same(job: Job, folder: DataFolder) -> None:
    """Refuse a folder whose manifest belongs to another job or is corrupt."""
    old = _check_format(folder)
    if old.get("config_hash") == job.config_hash:
        read_manifest(folder)
        for name in folder.sidecars():
            try:
                found = folder.read_checksummed(name).get("config_hash")
            except InputError:  # rendered again
                continue
            # Rendering would overwrite files of another run.
            if found != job.config_hash:
                what = f"{name.removesuffix('.json')} belongs to another data set than {MANIFEST_NAME}"
                raise InputError(what, where=folder, hint=f"move it away, or see: mbtf-gen repair {folder}")
        return
    after = {**job.config.model_dump(mode="json"), "inputs": dict(job.material.digests)}
    raise other_data_set(folder, old, {**after, "schema": SCHEMA_VERSION})


def other_data_set(folder: DataFolder, old: Mapping[str, Any], after: Mapping[str, Any]) -> InputError:
    """Error for a folder whose manifest `old` is not that of the configuration `after`."""
    config = old["config"] if isinstance(old.get("config"), dict) else {}
    before = {**config, "inputs": old.get("inputs", {}), "schema": old.get("schema")}
    if not differences(before, after):
        read_manifest(folder)
    return other_configuration(folder, "a data set", before, after)
