"""The output folder of a data set: created, resumed, replaced, or refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from mbtf_core.config.settings import differences
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.documents import read_manifest, repair_hint
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.geometry import encode_geometry, geometry_record
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
from mbtf_core.files.locks import brief_lock
from mbtf_gen.generation.manifest import DataSource, build_manifest, stored_plan
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import geometry_of


def has_dataset(folder: DataFolder, config_hash: str) -> bool:
    """Whether a folder contains a data set of this configuration, finished or not."""
    if not folder.has(MANIFEST_NAME):
        return False
    return folder.read_json(MANIFEST_NAME, repair_hint(folder)).get("config_hash") == config_hash


def _holds_dataset(folder: DataFolder) -> bool:
    """Whether an output folder contains a data set; an InputError if it contains something else."""
    if folder.local is not None:
        return check_folder(folder.local, lambda path: (path / MANIFEST_NAME).exists(), "data set")
    if folder.names() and not folder.has(MANIFEST_NAME):
        raise InputError("is not empty and holds no data set", where=folder, hint=ELSEWHERE)
    return folder.has(MANIFEST_NAME)


def claim_folder(
    source: DataSource, folder: DataFolder, build: Callable[[], dict[str, Any]], overwrite: bool
) -> dict[str, Any]:
    """Create, resume or replace a data set in a folder; returns its manifest.

    If several writers start a data set at once, one writes the manifest and the others adopt it.

    Parameters
    ----------
    build : builds the manifest; called only if one is to be written

    Raises
    ------
    InputError : the folder contains something else, or a corrupt manifest
    PartialError : it cannot be written, or other processes write the data set that is to be replaced
    """
    if folder.exists() and not folder.has(MANIFEST_NAME) and folder.sidecars():
        raise InputError(f"no {MANIFEST_NAME} in it", where=folder, hint=repair_hint(folder))
    present, content = _holds_dataset(folder), b""
    if present and overwrite:
        _check_format(folder)
    elif present:
        _check_same(source, folder)
        if folder.has(CONFIG_NAME):
            return read_manifest(folder)
    # Planning takes long: it comes before any change, and outside the lock.
    if overwrite or not present:
        content = checksummed(build())
    if present and overwrite:
        folder.clear()
    make_folder(folder.workspace)
    with brief_lock(folder.workspace / MANIFEST_NAME):
        remove_unfinished(folder.workspace, (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME))
        # The manifest comes first: it marks the folder as a data set, at whatever instant the run is killed.
        if content and not folder.write(MANIFEST_NAME, content, new=True):
            folder.refresh()
            _check_same(source, folder)
        manifest = read_manifest(folder)
        if not folder.has(CONFIG_NAME):
            folder.write(CONFIG_NAME, dump_yaml(manifest["config"]).encode())
    return manifest


def open_folder(
    job: Job, folder: DataFolder, plan: Callable[[Job], RunPlan], overwrite: bool = False
) -> RunPlan:
    """:func:`claim_folder` for a job, with its geometry; returns the run plan of the manifest.

    Parameters
    ----------
    plan : plans the run; called only if a manifest is to be written
    """
    geometry = cache(lambda effects: geometry_of(job, effects))

    def build() -> dict[str, Any]:
        new = plan(job)
        return build_manifest(job, new, geometry_record(geometry(new.effects)))

    manifest = claim_folder(job, folder, build, overwrite)
    stored = stored_plan(manifest, folder.at(MANIFEST_NAME))
    if manifest["geometry"] is not None and not folder.has(GEOMETRY_NAME):
        found = geometry(stored.effects)
        if geometry_record(found)["sha256"] != manifest["geometry"]["sha256"]:
            raise InputError(
                "cannot be restored: this machine computes it differently",
                where=folder.at(GEOMETRY_NAME),
                hint="repair it on the machine that generated it, or generate the data set again",
            )
        with brief_lock(folder.workspace / MANIFEST_NAME):
            folder.write(GEOMETRY_NAME, encode_geometry(found))
    return stored


def read_run_plan(folder: str | Path | DataFolder) -> RunPlan:
    """The run plan in a data set's manifest; an InputError where that is corrupt."""
    found = DataFolder.open(folder)
    return stored_plan(read_manifest(found), found.at(MANIFEST_NAME))


def _check_format(folder: DataFolder) -> dict[str, Any]:
    manifest = folder.read_json(MANIFEST_NAME, repair_hint(folder))
    if manifest.get("format") != FORMAT_NAME:
        what = f"is not a manifest of {FORMAT_NAME}"
        raise InputError(what, where=folder.at(MANIFEST_NAME), hint=ELSEWHERE)
    return manifest


def _check_same(source: DataSource, folder: DataFolder) -> None:
    """Refuse a folder whose manifest belongs to another data set or is corrupt."""
    old = _check_format(folder)
    if old.get("config_hash") != source.config_hash:
        stored = old["config"] if isinstance(old.get("config"), dict) else {}
        before = {**stored, "inputs": old.get("inputs", {}), "schema": old.get("schema")}
        after = source.config.model_dump(mode="json")
        after |= {"inputs": dict(source.inputs), "schema": SCHEMA_VERSION}
        if not differences(before, after):
            read_manifest(folder)
        raise other_configuration(folder, "a data set", before, after)
    read_manifest(folder)
    for name in folder.sidecars():
        try:
            found = folder.read_checksummed(name).get("config_hash")
        except InputError:  # rendered again
            continue
        # Rendering would overwrite files of another run.
        if found != source.config_hash:
            what = f"{name.removesuffix('.json')} belongs to another data set than {MANIFEST_NAME}"
            raise InputError(what, where=folder, hint=f"move it away, or see: mbtf-gen repair {folder}")
