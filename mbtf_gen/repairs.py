"""Restores what ``verify`` finds missing or corrupt, and nothing else.

The manifest describes the data set. If it is corrupt or missing, the sidecars replace it as evidence. Each
contains the hash of the configuration and the digest of the run plan. A manifest rebuilt from ``config.yaml``
and the material is accepted only if both match. Where manifest, sidecars and ``config.yaml`` disagree,
nothing is changed until the user chooses which of them to keep.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mbtf_core.atomic import read_checksummed, read_json, write_checksummed, write_text
from mbtf_core.config_file import differences, dump_yaml, in_short, read_yaml
from mbtf_core.data_folder import data_folder, send
from mbtf_core.digest import file_sha256
from mbtf_core.errors import InputError, MbtfError
from mbtf_core.locks import brief_lock
from mbtf_core.run.runner import Runner
from mbtf_core.shard_schema import (
    CONFIG_NAME,
    FORMAT_NAME,
    GEOMETRY_NAME,
    MANIFEST_NAME,
    SCHEMA_VERSION,
    ShardEntry,
)
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset.folder import check_geometry
from mbtf_gen.dataset.geometry import Geometry, geometry_of, geometry_record, write_geometry
from mbtf_gen.dataset.manifest import build_manifest, plan_digest
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.render_shards import ProgressCallback, render_shards
from mbtf_gen.dataset.sidecar import sidecars
from mbtf_gen.dataset.summary import finish, read_run_plan
from mbtf_gen.dataset.verify import INCOMPLETE, TWICE, Fault, foreign_files, shard_faults, verify
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import RunPlan, plan_run

_AGAIN = "generate the data set again, into another folder"
_DOCUMENTS = (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME)


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
        Files of the shards that were rendered again.
    documents : list of str
        Manifest, configuration and geometry, if they were written again.
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
    complete: bool
    paths: int
    seconds: float


@dataclass
class Group:
    """Files of a folder that belong to one data set, by the configuration and run plan that they state."""

    config_hash: str
    plan: str
    name: str
    shards: int = 0
    documents: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        shards = [f"{self.shards} shard{'s' if self.shards > 1 else ''}"] if self.shards else []
        return f"{self.name} ({', '.join([*self.documents, *shards])})"


@dataclass
class Corruption:
    """The faults of the data set in `folder` and how to repair them; :meth:`repair` does.

    Its properties raise an InputError where a repair is impossible.
    """

    folder: Path
    material: str | None = None
    keep: str | None = None
    _jobs: dict[str, Job] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.folder = data_folder(self.folder)
        if not self.folder.is_dir():
            raise InputError("no such folder", where=self.folder)
        lost = not (self.folder / MANIFEST_NAME).exists()
        if self._intact is not None or (lost and not sidecars(self.folder)):
            Dataset.open(self.folder)
        if "measured" in (self._intact or {}):
            raise InputError(
                "holds measured data, which cannot be generated again",
                where=self.folder,
                hint="remove the damaged files, then run the same mbtf-gen import again",
            )

    @cached_property
    def faults(self) -> list[Fault]:
        """The faults that :func:`verify` finds, or that the manifest cannot be read or is foreign."""
        if self._intact is not None and self._manifest is None:
            return [Fault(MANIFEST_NAME, "belongs to another data set", _AGAIN)]
        try:
            return verify(self.folder)
        except InputError as error:
            if self._intact is not None:
                raise
            return [Fault(MANIFEST_NAME, error.what, _AGAIN)]

    @cached_property
    def _intact(self) -> dict[str, Any] | None:
        """The manifest, if it is intact."""
        try:
            return read_checksummed(self.folder / MANIFEST_NAME)
        except InputError:
            return None

    @cached_property
    def _manifest(self) -> dict[str, Any] | None:
        """The manifest, if it is intact and of the data set that is repaired."""
        return self._intact if self.kept is not None and MANIFEST_NAME in self.kept.documents else None

    @cached_property
    def groups(self) -> list[Group]:
        """Which files belong together. ``config.yaml`` is left out where it is damaged."""
        found: dict[tuple[str, str], Group] = {}

        def group(config_hash: object, plan: object) -> Group:
            key = str(config_hash), str(plan)
            same = any(config == key[0] and key not in found for config, _ in found)
            return found.setdefault(key, Group(*key, "-".join(k[:8] for k in key[: 1 + same])))

        manifest, listed = self._intact, sidecars(self.folder)
        if manifest is not None:
            group(manifest["config_hash"], plan_digest(manifest)).documents.append(MANIFEST_NAME)
            entries = (e for content in manifest["splits"].values() for e in content["shards"])
            names = {Path(entry["file"]).stem for entry in entries}
            listed = [path for path in listed if path.stem in names]
        for path in listed:
            try:
                record = read_checksummed(path)
            except InputError:
                continue
            if (record.get("format"), record.get("schema")) == (FORMAT_NAME, SCHEMA_VERSION):
                group(record.get("config_hash"), record.get("plan")).shards += 1
        if found and (config_hash := self._config_hash({key[0] for key in found})):
            plans = [plan for config, plan in found if config == config_hash]
            group(config_hash, plans[0] if plans else None).documents.append(CONFIG_NAME)
        return [*found.values()]

    def _config_hash(self, known: set[str]) -> str | None:
        """Hash of the configuration in ``config.yaml``; None where it is unknown."""
        path, intact, guess = self.folder / CONFIG_NAME, self._intact, None
        try:
            config = GeneratorConfig.model_validate(read_yaml(path))
        except (MbtfError, ValidationError):
            return None
        if intact is not None:
            if file_sha256(path) == intact.get("config_yaml"):
                return str(intact["config_hash"])
            # The options with the manifest's inputs: the material may be elsewhere by now.
            guess = config.hash(intact.get("inputs", {}))
            if known == {guess}:
                return guess
        try:
            found = self._prepare(self._located(config)).config_hash
        except MbtfError:
            found = None
        if found in known:
            return found
        return None if guess in known else guess

    def _prepare(self, config: GeneratorConfig) -> Job:
        """Job of a configuration, whose material is loaded once."""
        key = config.model_dump_json()
        if key not in self._jobs:
            self._jobs[key] = Job.prepare(config)
        return self._jobs[key]

    def _located(self, config: GeneratorConfig) -> GeneratorConfig:
        return config.model_copy(update={"material": self.material}) if self.material else config

    @cached_property
    def kept(self) -> Group | None:
        """The data set that is repaired; an InputError if there are several and none is chosen."""
        groups, chosen = self.groups, self.keep
        if chosen is None and len(groups) < 2:
            return groups[0] if groups else None
        for found in groups:
            if found.name == chosen and (found.shards or MANIFEST_NAME in found.documents):
                return found
        what = f"its files belong to {len(groups)} data sets: {', '.join(map(str, groups))}"
        if chosen is not None:
            names = ", ".join(map(str, groups)) or "none"
            what = f"--keep {chosen} names no data set that can be restored; there are: {names}"
        hint = f"nothing was changed; choose one: mbtf-gen repair {self.folder} --keep NAME"
        raise InputError(what, where=self.folder, hint=hint)

    def _configurations(self) -> Iterator[GeneratorConfig]:
        """Configurations that can be read, the manifest's first."""
        first = None
        for read in (
            lambda: read_json(self.folder / MANIFEST_NAME)["config"],
            lambda: read_yaml(self.folder / CONFIG_NAME),
        ):
            try:
                config = GeneratorConfig.model_validate(read())
            except (MbtfError, KeyError, ValidationError):
                continue
            if config != first:
                yield self._located(config)
            first = config

    @cached_property
    def job(self) -> Job:
        """The job of the data set."""
        if self.kept is None:
            raise InputError(
                "cannot be restored: no sidecar of the folder is intact",
                where=self.folder / MANIFEST_NAME,
                hint=_AGAIN,
            )
        tried: list[Job] = []
        for config in self._configurations():
            if not Path(config.material).exists():
                raise InputError(
                    f"the material is not at '{config.material}'",
                    where=self.folder,
                    hint="give its path: mbtf-gen repair FOLDER --material PATH",
                )
            job = self._prepare(config)
            if job.config_hash == self.kept.config_hash:
                return job
            tried.append(job)
        if not tried:
            raise InputError(
                f"neither {MANIFEST_NAME} nor {CONFIG_NAME} can be read", where=self.folder, hint=_AGAIN
            )
        before = (self._manifest or {}).get("inputs", {})
        changes = in_short(differences(before, tried[0].material.digests))
        what = f" ({changes})" if before and changes else ""
        raise InputError(
            f"the material or the configuration has changed since the data set was generated{what}",
            where=self.folder,
            hint="restore it, or generate the data set again",
        )

    @cached_property
    def plan(self) -> RunPlan:
        """The run plan of the data set."""
        if self._manifest is not None:
            return read_run_plan(self.folder)
        plan = plan_run(self.job)
        if self.kept is None or plan_digest(plan.to_manifest()) != self.kept.plan:
            raise InputError(
                "cannot be restored: this machine plans the run differently",
                where=self.folder / MANIFEST_NAME,
                hint="repair it on the machine that generated it, or generate the data set again",
            )
        return plan

    @cached_property
    def documents(self) -> list[str]:
        """Manifest, configuration and geometry, if they have to be written again."""
        names = {f.file for f in self.faults if f.file in _DOCUMENTS and f.what != INCOMPLETE}
        if self._manifest is None or any(f.what == TWICE for f in self.faults):
            restored = self._restored
            digests = {CONFIG_NAME: restored["config_yaml"]}
            if restored["geometry"] is not None:
                digests[GEOMETRY_NAME] = restored["geometry"]["sha256"]
            for name, digest in digests.items():
                path = self.folder / name
                names |= {name} if not path.exists() or file_sha256(path) != digest else set()
            names.add(MANIFEST_NAME)
        elif GEOMETRY_NAME in names and self._geometry is not None:
            check_geometry(self.folder, self._geometry, self._manifest)
        return sorted(names, reverse=True)

    @cached_property
    def _geometry(self) -> Geometry | None:
        return geometry_of(self.job, self.plan.effects)

    @cached_property
    def _restored(self) -> dict[str, Any]:
        """The manifest as it was before any shard was rendered."""
        return build_manifest(self.job, self.plan, geometry_record(self._geometry))

    @cached_property
    def entries(self) -> list[ShardEntry]:
        """Shards that are missing or corrupt; with a corrupt manifest, those of the restored one."""
        job, faults = self.job, self.faults
        if self._manifest is None:
            digest = plan_digest(self.plan.to_manifest())
            faults = [*shard_faults(self.folder, job.shards, job.config_hash, digest)]
        faulty = {f.file for f in faults if f.what != TWICE}
        return [e for e in job.shards if e.file in faulty]

    @property
    def foreign(self) -> list[str]:
        """Files that are no part of the data set."""
        return foreign_files(self.folder, self.job.shards)

    def repair(self, progress: ProgressCallback | None = None) -> RepairResult:
        """See :func:`repair`."""
        documents, entries, plan = self.documents, self.entries, self.plan
        path = self.folder / MANIFEST_NAME
        if documents or entries:
            with brief_lock(path):
                if MANIFEST_NAME in documents:
                    write_checksummed(path, self._restored)
                    send(path)
                manifest = read_checksummed(path)
                if entries and manifest["complete"]:
                    # Readers rely on this key, and rendering removes the corrupt shards.
                    write_checksummed(path, {**manifest, "complete": False, "summary": None})
                    send(path)
                if CONFIG_NAME in documents:
                    write_text(self.folder / CONFIG_NAME, dump_yaml(manifest["config"]))
                    send(self.folder / CONFIG_NAME)
                if GEOMETRY_NAME in documents and self._geometry is not None:
                    write_geometry(self.folder / GEOMETRY_NAME, self._geometry)
                    send(self.folder / GEOMETRY_NAME)
        corrupt = {e.file for e in entries}
        result = render_shards(
            self.job, self.folder, entries, plan, Runner(), corrupt=corrupt, progress=progress
        )
        return RepairResult(
            folder=str(self.folder),
            faults=self.faults,
            shards=result.shards,
            documents=documents,
            foreign=self.foreign,
            complete=finish(self.folder).complete,
            paths=result.paths,
            seconds=round(result.seconds, 3),
        )


def repair(
    folder: str | Path,
    *,
    material: str | None = None,
    keep: str | None = None,
    progress: ProgressCallback | None = None,
) -> RepairResult:
    """Restore what ``verify`` finds missing or corrupt; the data set is then identical to the original.

    Parameters
    ----------
    folder : str or Path
        The data set: a path or a URL.
    material : str, optional
        Current path of the material; by default the path in the data set's configuration.
    keep : str, optional
        Which data set to restore where the files belong to several, by the name in that error.
    progress : callable, optional
        As in :func:`~mbtf_gen.generation.generate`.

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
    return Corruption(data_folder(folder), material, keep).repair(progress)
