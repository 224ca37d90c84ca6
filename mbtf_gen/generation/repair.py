"""Restores what ``verify`` finds missing or corrupt: it is generated again, with the same bits.

The manifest says what the data set contains. If it is lost, it is built again from ``config.yaml`` and the
material, and accepted only if it has the digests of configuration and run plan that the sidecars state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mbtf_core.config.settings import differences, in_short
from mbtf_core.config.yaml_file import dump_yaml, read_yaml
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.documents import plan_digest
from mbtf_core.data.folder import DataFolder, sidecar_name
from mbtf_core.data.geometry import encode_geometry, geometry_record
from mbtf_core.data.schema import CONFIG_NAME, FORMAT_NAME, GEOMETRY_NAME, MANIFEST_NAME, SCHEMA_VERSION
from mbtf_core.data.verify import INCOMPLETE, Fault, document_faults, foreign_files, shard_faults
from mbtf_core.errors import InputError, MbtfError
from mbtf_core.files.atomic import checksummed
from mbtf_core.locks import brief_lock
from mbtf_core.run.runner import Runner
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import check_geometry
from mbtf_gen.generation.geometry import geometry_of
from mbtf_gen.generation.manifest import build_manifest, stored_plan
from mbtf_gen.generation.render_shards import ProgressCallback, render_shards
from mbtf_gen.generation.summary import finish
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import RunPlan, plan_run

_AGAIN = "generate the data set again, into another folder"
_SHOWN = 3


@dataclass(frozen=True)
class RepairResult:
    """Result of a repair.

    Attributes
    ----------
    folder : str
        The data set.
    faults : list of Fault
        Faults before the repair.
    shards : list of str
        Files of the shards that were rendered again, or would be.
    documents : list of str
        Manifest, configuration and geometry, if they were written again, or would be.
    foreign : list of str
        Files in the folder that are no part of the data set; they are left alone.
    complete : bool
        Whether all shards are finished now.
    paths : int
        Paths traced.
    seconds : float
        Duration of the rendering.
    """

    folder: str
    faults: list[Fault]
    shards: list[str]
    documents: list[str]
    foreign: list[str]
    complete: bool = False
    paths: int = 0
    seconds: float = 0.0


def repair(
    folder: str | Path | DataFolder,
    *,
    material: str | None = None,
    dry_run: bool = False,
    progress: ProgressCallback | None = None,
) -> RepairResult:
    """Restore what ``verify`` finds missing or corrupt; the data set is then identical to the original.

    Parameters
    ----------
    folder : str, Path or DataFolder
        The data set: a path or a URL.
    material : str, optional
        Current path of the material; by default the path in the data set's configuration.
    dry_run : bool
        Only find out what would be restored.
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
    manifest, damage = _manifest(folder)
    job = _job(folder, manifest, material)
    plan, geometry = _plan(folder, job, manifest), None
    if manifest is None or manifest["geometry"] is not None:
        geometry = geometry_of(job, plan.effects)
    if manifest is not None and _listed(manifest) != [(entry.file, entry.rows) for entry in job.shards]:
        damage = "does not list the shards of its configuration"
    whole = manifest
    if whole is None or damage is not None:
        whole = build_manifest(job, plan, geometry_record(geometry))

    faults = [] if damage is None else [Fault(MANIFEST_NAME, damage, _AGAIN)]
    faults += document_faults(folder, whole)
    documents = [fault.file for fault in faults]
    digest = plan_digest(plan.to_manifest())
    broken = list(shard_faults(folder, job.shards, job.config_hash, digest))
    faulty = {fault.file for fault in broken}
    entries = [entry for entry in job.shards if entry.file in faulty]
    faults += broken
    if not faults and not whole["complete"]:
        faults.append(Fault(MANIFEST_NAME, INCOMPLETE, _AGAIN))
    if geometry is not None and manifest is not None and GEOMETRY_NAME in documents:
        check_geometry(folder, geometry, manifest)
    foreign = foreign_files(folder, job.shards)
    documents = sorted(documents, reverse=True)
    if dry_run:
        return RepairResult(str(folder), faults, [e.file for e in entries], documents, foreign)

    with brief_lock(folder.workspace / MANIFEST_NAME):
        # Readers rely on `complete`.
        if MANIFEST_NAME in documents or (entries and whole["complete"]):
            whole |= {"complete": False, "summary": None}
            folder.write(MANIFEST_NAME, checksummed(whole))
        if CONFIG_NAME in documents:
            folder.write(CONFIG_NAME, dump_yaml(whole["config"]).encode())
        if GEOMETRY_NAME in documents and geometry is not None:
            folder.write(GEOMETRY_NAME, encode_geometry(geometry))
        # A shard without its sidecar is unfinished, so that generation renders it.
        for entry in entries:
            folder.delete(sidecar_name(entry.file))
    result = render_shards(job, folder, entries, plan, Runner(), progress=progress)
    return RepairResult(
        folder=str(folder),
        faults=faults,
        shards=result.shards,
        documents=documents,
        foreign=foreign,
        complete=finish(folder).complete,
        paths=result.paths,
        seconds=round(result.seconds, 3),
    )


def _manifest(folder: DataFolder) -> tuple[dict[str, Any] | None, str | None]:
    """(manifest, None), or (None, fault) where it is lost or damaged."""
    try:
        folder.read_checksummed(MANIFEST_NAME)
    except InputError as error:
        return None, error.what
    manifest = Dataset.open(folder).manifest
    if "measured" in manifest:
        raise InputError(
            "holds measured data, which cannot be generated again",
            where=folder,
            hint="remove the damaged files, then run the same mbtf-gen import again",
        )
    return folder.read_checksummed(MANIFEST_NAME), None


def _listed(manifest: dict[str, Any]) -> list[tuple[str, int]]:
    return [(e["file"], e["rows"]) for split in manifest["splits"].values() for e in split["shards"]]


def _sidecars(folder: DataFolder) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and contents of the intact sidecars of this schema version."""
    for name in folder.sidecars():
        try:
            record = folder.read_checksummed(name)
        except InputError:
            continue
        if (record.get("format"), record.get("schema")) == (FORMAT_NAME, SCHEMA_VERSION):
            yield name, record


def _job(folder: DataFolder, manifest: dict[str, Any] | None, material: str | None) -> Job:
    """The job of the data set, from the manifest's configuration or that of ``config.yaml``."""
    stated = {} if manifest is None else {str(manifest["config_hash"]): [MANIFEST_NAME]}
    for name, record in _sidecars(folder):
        stated.setdefault(str(record.get("config_hash")), []).append(name)
    if len(stated) > 1:
        groups = (f"{', '.join(n[:_SHOWN])}{', …' if len(n) > _SHOWN else ''}" for n in stated.values())
        raise InputError(
            f"its files belong to {len(stated)} data sets: {'; '.join(groups)}",
            where=folder,
            hint="nothing was changed; move away those that do not belong here, then repair it again",
        )
    if not stated:
        what = "cannot be restored: no sidecar of the folder is intact"
        raise InputError(what, where=folder.at(MANIFEST_NAME), hint=_AGAIN)
    tried: list[Job] = []
    for config in _configurations(folder, material):
        if not Path(config.material).exists():
            raise InputError(
                f"the material is not at '{config.material}'",
                where=folder,
                hint="give its path: mbtf-gen repair FOLDER --material PATH",
            )
        job = Job.prepare(config)
        if job.config_hash in stated:
            return job
        tried.append(job)
    if not tried:
        what = f"neither {MANIFEST_NAME} nor {CONFIG_NAME} can be read"
        raise InputError(what, where=folder, hint=_AGAIN)
    before = (manifest or {}).get("inputs", {})
    changes = in_short(differences(before, tried[0].material.digests)) if before else ""
    raise InputError(
        "the material or the configuration has changed since the data set was generated"
        + (f" ({changes})" if changes else ""),
        where=folder,
        hint="restore it, or generate the data set again",
    )


def _configurations(folder: DataFolder, material: str | None) -> Iterator[GeneratorConfig]:
    """Configurations that can be read, the manifest's first."""
    found: list[GeneratorConfig] = []
    for read in (
        lambda: folder.read_json(MANIFEST_NAME)["config"],
        lambda: _yaml(folder),
    ):
        try:
            config = GeneratorConfig.model_validate(read())
        except (MbtfError, KeyError, ValueError, ValidationError):
            continue
        if config not in found:
            found.append(config)
            yield config.model_copy(update={"material": material}) if material else config


def _yaml(folder: DataFolder) -> Any:
    if not folder.has(CONFIG_NAME):
        raise InputError("no such file", where=folder.at(CONFIG_NAME))
    with folder.fresh(CONFIG_NAME) as path:
        return read_yaml(path)


def _plan(folder: DataFolder, job: Job, manifest: dict[str, Any] | None) -> RunPlan:
    """The run plan of the data set."""
    if manifest is not None:
        return stored_plan(manifest, folder.at(MANIFEST_NAME))
    plan = plan_run(job)
    if plan_digest(plan.to_manifest()) not in {record.get("plan") for _, record in _sidecars(folder)}:
        raise InputError(
            "cannot be restored: this machine plans the run differently",
            where=folder.at(MANIFEST_NAME),
            hint="repair it on the machine that generated it, or generate the data set again",
        )
    return plan
