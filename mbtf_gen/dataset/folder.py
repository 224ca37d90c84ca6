"""The output folder of a data set: created, resumed, replaced, or refused."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mbtf_core.atomic import (
    TEMPORARY,
    checksummed,
    create_file,
    read_checksummed,
    read_json,
    unwritable,
    write_text,
)
from mbtf_core.config_file import differences, dump_yaml
from mbtf_core.data_folder import data_folder, send
from mbtf_core.errors import InputError, PartialError
from mbtf_core.folders import ELSEWHERE, check_folder, make_folder, other_configuration, remove_unfinished
from mbtf_core.locks import brief_lock, lock_owner, shard_lock, take_lock
from mbtf_core.shard_schema import (
    CONFIG_NAME,
    FORMAT_NAME,
    GEOMETRY_NAME,
    MANIFEST_NAME,
    SCHEMA_VERSION,
    SPLITS,
)
from mbtf_gen.dataset.geometry import Geometry, geometry_of, geometry_record, write_geometry
from mbtf_gen.dataset.manifest import build_manifest, stored_plan
from mbtf_gen.dataset.sidecar import repair_hint, sidecars
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import RunPlan

# Files that a run writes, unfinished files that a killed run leaves, and locks.
_SHARD = rf"(?:{'|'.join(SPLITS)})-\d+"
_DOCUMENTS = "|".join(re.escape(name) for name in (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME))
_OWN = re.compile(rf"{_DOCUMENTS}|{_SHARD}\.(?:npz|exr|json)")
_UNFINISHED = re.compile(rf"\.({_OWN.pattern}){TEMPORARY}")
_LOCK = re.compile(rf"\.({_SHARD}|{re.escape(Path(MANIFEST_NAME).stem)})\.lock")


def is_leftover(name: str) -> bool:
    """Whether a file is a lock, or what a killed run left unfinished."""
    return bool(_LOCK.fullmatch(name) or _UNFINISHED.fullmatch(name))


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a folder; an InputError unless it is exactly as it was written."""
    return read_checksummed(folder / MANIFEST_NAME, repair_hint(folder))


def has_dataset(folder: Path, config_hash: str) -> bool:
    """Whether a folder contains a data set of this configuration, finished or not."""
    path = folder / MANIFEST_NAME
    return path.exists() and read_json(path, repair_hint(folder)).get("config_hash") == config_hash


def open_folder(job: Job, folder: Path, plan: Callable[[Job], RunPlan], overwrite: bool) -> None:
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
    existing = folder / MANIFEST_NAME
    if folder.is_dir() and not existing.exists() and sidecars(folder):
        raise InputError(f"no {MANIFEST_NAME} in it", where=folder, hint=repair_hint(folder))
    present = check_folder(folder, lambda path: (path / MANIFEST_NAME).exists(), "data set")
    replace = overwrite and present
    if replace:
        _check_format(existing)
    elif present:
        _check_same(job, folder)
        if (folder / CONFIG_NAME).exists() and (
            job.material.grid is None or (folder / GEOMETRY_NAME).exists()
        ):
            return
    # Planning takes long: it comes before any change, and outside the lock.
    content = b""
    if replace or not existing.exists():
        new = plan(job)
        geometry = geometry_of(job, new.effects)
        content = checksummed(build_manifest(job, new, geometry_record(geometry)))
    else:
        geometry = geometry_of(job, stored_plan(read_manifest(folder), existing).effects)
    if replace:
        clear(folder)
    make_folder(folder)
    with brief_lock(existing):
        remove_unfinished(folder, (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME))
        # The manifest comes first: it marks the folder as a data set, at whatever instant the run is killed.
        adopted = bool(content) and not (create_file(existing, content) and send(existing, new=True))
        if adopted:
            # In a store it is known once the folder is read again.
            _check_same(job, data_folder(folder))
        manifest = read_manifest(folder)
        if not (folder / CONFIG_NAME).exists():
            write_text(folder / CONFIG_NAME, dump_yaml(manifest["config"]))
            send(folder / CONFIG_NAME)
        if geometry is not None and not (folder / GEOMETRY_NAME).exists():
            if adopted:
                # The plan of the other writer may simulate other effects.
                geometry = geometry_of(job, stored_plan(manifest, existing).effects)
            assert geometry is not None
            check_geometry(folder, geometry, manifest)
            write_geometry(folder / GEOMETRY_NAME, geometry)
            send(folder / GEOMETRY_NAME)


def check_geometry(folder: Path, geometry: Geometry, manifest: Mapping[str, Any]) -> None:
    """An InputError unless a geometry is the one whose digest a manifest contains."""
    record = geometry_record(geometry)
    if record is None or record["sha256"] != manifest["geometry"]["sha256"]:
        raise InputError(
            "cannot be restored: this machine computes it differently",
            where=folder / GEOMETRY_NAME,
            hint="repair it on the machine that generated it, or generate the data set again",
        )


def _check_format(path: Path) -> dict[str, Any]:
    manifest = read_json(path, repair_hint(path.parent))
    if manifest.get("format") != FORMAT_NAME:
        raise InputError(f"is not a manifest of {FORMAT_NAME}", where=path, hint=ELSEWHERE)
    return manifest


def _check_same(job: Job, folder: Path) -> None:
    """Refuse a folder whose manifest belongs to another job or is corrupt."""
    old = _check_format(folder / MANIFEST_NAME)
    if old.get("config_hash") == job.config_hash:
        read_manifest(folder)
        for path in sidecars(folder):
            try:
                found = read_checksummed(path).get("config_hash")
            except InputError:  # rendered again
                continue
            # Rendering would overwrite files of another run.
            if found != job.config_hash:
                what = f"{path.stem} belongs to another data set than {MANIFEST_NAME}"
                raise InputError(what, where=folder, hint=f"move it away, or see: mbtf-gen repair {folder}")
        return
    config = old["config"] if isinstance(old.get("config"), dict) else {}
    before = {**config, "inputs": old.get("inputs", {}), "schema": old.get("schema")}
    inputs = dict(job.material.digests)
    after = {**job.config.model_dump(mode="json"), "inputs": inputs, "schema": SCHEMA_VERSION}
    if not differences(before, after):
        read_manifest(folder)
    raise other_configuration(folder, "a data set", before, after)


def _locks(folder: Path) -> Iterator[Path]:
    """Paths from which :func:`take_lock` finds the locks of a folder."""
    for path in sorted(folder.iterdir()):
        if match := _LOCK.fullmatch(path.name):
            yield folder / f"{match[1]}.npz"


def remove_leftovers(folder: Path) -> None:
    """Remove the locks and unfinished files of killed runs, unless a process holds the lock."""
    general, documents = Path(MANIFEST_NAME).stem, [CONFIG_NAME, GEOMETRY_NAME]
    stems = {path.stem for path in _locks(folder)}
    for path in folder.iterdir():
        if match := _UNFINISHED.fullmatch(path.name):
            stems.add(general if match[1] in documents else Path(match[1]).stem)
    for stem in sorted(stems):
        with shard_lock(folder / f"{stem}.npz") as held:
            if held:
                files = [f"{stem}{suffix}" for suffix in (".npz", ".exr", ".json")]
                remove_unfinished(folder, [*files, *(documents if stem == general else [])])


def clear(folder: Path) -> None:
    """Remove a data set and nothing else, the manifest last, so that shards never remain without it."""
    with ExitStack() as held:
        for path in _locks(folder):
            lock = take_lock(path)
            if lock is None:
                raise PartialError(
                    f"is being written by another process ({lock_owner(path)})",
                    where=folder,
                    hint="wait for it or stop it, then run the same command again",
                )
            held.callback(lock.release)
        files = [f for f in folder.iterdir() if any(p.fullmatch(f.name) for p in (_OWN, _UNFINISHED, _LOCK))]
        try:
            for file in sorted(files, key=lambda file: file.name == MANIFEST_NAME):
                file.unlink(missing_ok=True)
        except OSError as error:
            raise unwritable(folder, error) from None
