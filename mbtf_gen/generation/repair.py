"""Repairs a data set: what ``verify`` finds damaged is removed, and generated again.

The data set's own configuration generates it, by the code of a resumed run, so that files have the same bits
as before. A lost manifest is built from ``config.yaml``, if the sidecars state the digests of this
configuration and of its plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.config.settings import build, differences, in_short
from mbtf_core.config.yaml_file import read_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import plan_digest
from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.data.geometry import geometry_record
from mbtf_core.data.schema import CONFIG_NAME, MANIFEST_NAME
from mbtf_core.data.verify import INCOMPLETE, Fault, verify
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import checksummed
from mbtf_core.files.locks import brief_lock
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.manifest import build_manifest
from mbtf_gen.generation.run import ProgressCallback, generate
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import plan_run
from mbtf_gen.planning.simulation import geometry_of

_AGAIN = "generate the data set again, into another folder"


@dataclass(frozen=True)
class RepairResult:
    """Result of a repair.

    Attributes
    ----------
    folder : the data set
    faults : faults before the repair
    shards, documents : shards, and manifest, configuration and geometry, that were generated again
    complete : whether all shards are finished now
    paths, seconds : int, float; paths traced, and duration of the run
    """

    folder: str
    faults: list[Fault]
    shards: list[str]
    documents: list[str]
    complete: bool
    paths: int
    seconds: float


def repair(
    folder: str | Path | DataFolder,
    *,
    material: str | None = None,
    progress: ProgressCallback | None = None,
) -> RepairResult:
    """Restore what ``verify`` finds missing or corrupt; the data set is then identical to the original.

    Parameters
    ----------
    folder : str, Path or DataFolder
        The data set: a path or a URL.
    material : str, optional
        Current path of the material; by default the path in the data set's configuration.
    progress : callable, optional
        As in :func:`~mbtf_gen.generation.run.generate`.

    Returns
    -------
    RepairResult

    Raises
    ------
    InputError
        No data set, its material is missing or has changed, or its files belong to several data sets.
    PartialError
        Other processes write the data set, the disk is full, or the store cannot be reached. The same command
        resumes.
    """
    folder = DataFolder.open(folder)
    if not folder.exists() or not (folder.has(MANIFEST_NAME) or folder.sidecars()):
        Dataset.open(folder)  # says what is missing
    manifest, faults = _manifest(folder)
    job = _job(folder, manifest, material)
    if manifest is None:
        manifest = _restored_manifest(folder, job)
        folder.write(MANIFEST_NAME, checksummed(manifest))
    faults += verify(folder)
    shards = {fault.file for fault in faults} & {entry.file for entry in job.shards}
    documents = {fault.file for fault in faults if fault.what != INCOMPLETE} - shards
    with brief_lock(folder.workspace / MANIFEST_NAME):
        # Readers rely on `complete`.
        if shards and manifest["complete"]:
            folder.write(MANIFEST_NAME, checksummed({**manifest, "complete": False, "summary": None}))
        # A shard without its sidecar is unfinished.
        for name in (*map(sidecar_name, shards), *documents - {MANIFEST_NAME}):
            folder.delete(name)
    done = generate(job, folder, progress=progress)
    return RepairResult(
        str(folder), faults, sorted(shards), sorted(documents), done.complete, done.paths, done.seconds
    )


def _manifest(folder: DataFolder) -> tuple[dict[str, Any] | None, list[Fault]]:
    """The manifest; None and its fault where it is lost or damaged."""
    try:
        found = folder.read_checksummed(MANIFEST_NAME)
    except InputError as error:
        return None, [Fault(MANIFEST_NAME, error.what, _AGAIN)]
    Dataset.open(folder)  # says whether another version wrote it
    return found, []


def _job(folder: DataFolder, manifest: dict[str, Any] | None, material: str | None) -> Job:
    """The job of the manifest's configuration, or of ``config.yaml`` without one, to which all intact files
    must belong."""
    if manifest is not None:
        source, stored = folder.at(MANIFEST_NAME), manifest["config"]
    elif folder.has(CONFIG_NAME):
        with folder.fresh(CONFIG_NAME) as path:
            source, stored = folder.at(CONFIG_NAME), read_yaml(path)
    else:
        raise InputError(f"neither {MANIFEST_NAME} nor {CONFIG_NAME} can be read", where=folder, hint=_AGAIN)
    if "material" not in stored:
        raise InputError(
            "holds measured data, which cannot be generated again",
            where=folder,
            hint="remove the damaged files, then run the same mbtf-gen import again",
        )
    moved = {} if material is None else {"material": material}
    config = build(GeneratorConfig, {**stored, **moved}, source=source)
    if not Path(config.material).exists():
        raise InputError(
            f"the material is not at '{config.material}'",
            where=folder,
            hint="give its path: mbtf-gen repair FOLDER --material PATH",
        )
    job = Job.load(config)
    if manifest is not None and manifest["config_hash"] != job.config_hash:
        changes = in_short(differences(manifest["inputs"], job.material.digests))
        raise InputError(
            f"the material has changed since the data set was generated ({changes})",
            where=folder,
            hint="restore it, or generate the data set again",
        )
    others = [name for name, found in _stated(folder, "config_hash").items() if found != job.config_hash]
    if others:
        named = f"{', '.join(others[:3])}{', …' if len(others) > 3 else ''}"
        raise InputError(
            f"{named} belong to another configuration or material than {source}",
            where=folder,
            hint="nothing was changed; move away what does not belong here, then repair it again",
        )
    return job


def _stated(folder: DataFolder, key: str) -> dict[str, object]:
    """What the intact sidecars state, by their names."""
    found = {}
    for name in folder.sidecars():
        try:
            found[name] = folder.read_checksummed(name).get(key)
        except InputError:  # verify names it
            continue
    return found


def _restored_manifest(folder: DataFolder, job: Job) -> dict[str, Any]:
    """The manifest of an unfinished run, if an intact sidecar states its plan."""
    plan = plan_run(job)
    if plan_digest(plan.to_manifest()) not in _stated(folder, "plan").values():
        raise InputError(
            "cannot be restored: no intact sidecar states the plan that this machine makes",
            where=folder.at(MANIFEST_NAME),
            hint="repair it on the machine that generated it, or generate the data set again",
        )
    return build_manifest(job, plan, geometry_record(geometry_of(job, plan.effects)))
