"""Restores what ``verify`` finds missing or corrupt, and nothing else.

The manifest describes the data set. If it is corrupt, the sidecars replace it as evidence. Each contains the
hash of the configuration and the digest of the run plan. A manifest rebuilt from ``config.yaml`` and the
material is accepted only if both match.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mbtf_core.atomic import read_checksummed, read_json, write_checksummed, write_text
from mbtf_core.config_file import differences, dump_yaml, in_short, read_yaml
from mbtf_core.errors import InputError, MbtfError
from mbtf_core.locks import brief_lock
from mbtf_core.shard_schema import CONFIG_NAME, FORMAT_NAME, MANIFEST_NAME, ShardEntry
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset.manifest import build_manifest, plan_digest
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.render_shards import ProgressCallback, render_shards
from mbtf_gen.dataset.summary import finish, read_run_plan
from mbtf_gen.dataset.verify import INCOMPLETE, TWICE, UNLISTED, Fault, shard_faults, verify
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import RunPlan, plan_run

_AGAIN = "generate the data set again, into another folder"
_DOCUMENTS = (MANIFEST_NAME, CONFIG_NAME)


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
        Manifest and configuration, if they were written again.
    left : list of Fault
        Faults that remain: files that the manifest does not list.
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
    left: list[Fault]
    complete: bool
    paths: int
    seconds: float


@dataclass
class Corruption:
    """The faults of the data set in `folder` and how to repair them; :meth:`repair` does.

    Its properties raise an InputError where a repair is impossible.
    """

    folder: Path
    material: str | None = None

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise InputError("no such folder", where=self.folder)
        if not (self.folder / MANIFEST_NAME).exists() and self._evidence[0] is None:
            Dataset.open(self.folder)

    @cached_property
    def faults(self) -> list[Fault]:
        """The faults that :func:`verify` finds, or that the manifest cannot be read."""
        try:
            return verify(self.folder)
        except InputError as error:
            return [Fault(MANIFEST_NAME, error.what, _AGAIN)]

    @cached_property
    def _manifest(self) -> dict[str, Any] | None:
        """The manifest, if it is intact."""
        try:
            return read_checksummed(self.folder / MANIFEST_NAME)
        except InputError:
            return None

    @cached_property
    def _evidence(self) -> tuple[str | None, str | None]:
        """Hash of the configuration and digest of the run plan, by majority of the intact sidecars."""
        seen: Counter[tuple[str, str]] = Counter()
        for path in self.folder.glob("*-*.json"):
            try:
                record = read_checksummed(path)
            except InputError:
                continue
            if record.get("format") == FORMAT_NAME:
                seen[str(record.get("config_hash")), str(record.get("plan"))] += 1
        return seen.most_common(1)[0][0] if seen else (None, None)

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
                yield config.model_copy(update={"material": self.material}) if self.material else config
            first = config

    @cached_property
    def job(self) -> Job:
        """The job of the data set."""
        expected = self._evidence[0] if self._manifest is None else self._manifest["config_hash"]
        if expected is None:
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
            job = Job.prepare(config)
            if job.config_hash == expected:
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
        if plan_digest(plan.to_manifest()) != self._evidence[1]:
            raise InputError(
                "cannot be restored: this machine plans the run differently",
                where=self.folder / MANIFEST_NAME,
                hint="repair it on the machine that generated it, or generate the data set again",
            )
        return plan

    @cached_property
    def documents(self) -> list[str]:
        """Manifest and configuration, if they have to be written again."""
        names = {f.file for f in self.faults if f.file in _DOCUMENTS and f.what != INCOMPLETE}
        if self._manifest is None or any(f.what == TWICE for f in self.faults):
            names.add(MANIFEST_NAME)
        return sorted(names, reverse=True)

    @cached_property
    def entries(self) -> list[ShardEntry]:
        """Shards that are missing or corrupt; with a corrupt manifest, those of the restored one."""
        job, faults = self.job, self.faults
        if self._manifest is None:
            faults = [*shard_faults(self.folder, job.shards, job.config_hash, str(self._evidence[1]))]
        faulty = {f.file for f in faults if self._manifest is None or f.what not in (UNLISTED, TWICE)}
        return [e for e in job.shards if e.file in faulty]

    @cached_property
    def left(self) -> list[Fault]:
        """Faults that a repair leaves."""
        return [f for f in self.faults if f.what == UNLISTED]

    def repair(self, progress: ProgressCallback | None = None) -> RepairResult:
        """See :func:`repair`."""
        documents, entries, plan = self.documents, self.entries, self.plan
        path = self.folder / MANIFEST_NAME
        if documents or entries:
            with brief_lock(path):
                if MANIFEST_NAME in documents:
                    write_checksummed(path, build_manifest(self.job, plan))
                manifest = read_checksummed(path)
                if entries and manifest["complete"]:
                    # Readers rely on this key, and rendering removes the corrupt shards.
                    write_checksummed(path, {**manifest, "complete": False, "summary": None})
                if CONFIG_NAME in documents:
                    write_text(self.folder / CONFIG_NAME, dump_yaml(manifest["config"]))
        corrupt = {e.file for e in entries}
        result = render_shards(self.job, self.folder, entries, plan, corrupt=corrupt, progress=progress)
        return RepairResult(
            folder=str(self.folder),
            faults=self.faults,
            shards=result.shards,
            documents=documents,
            left=self.left,
            complete=finish(self.folder).complete,
            paths=result.paths,
            seconds=round(result.seconds, 3),
        )


def repair(
    folder: str | Path, *, material: str | None = None, progress: ProgressCallback | None = None
) -> RepairResult:
    """Restore what ``verify`` finds missing or corrupt; the data set is then identical to the original.

    Parameters
    ----------
    folder : str or Path
        The data set.
    material : str, optional
        Current path of the material; by default the path in the data set's configuration.
    progress : callable, optional
        As in :func:`~mbtf_gen.generation.generate`.

    Returns
    -------
    RepairResult

    Raises
    ------
    InputError
        No data set, or its material is missing or has changed.
    PartialError
        Other processes write the data set, or the disk is full. The same command resumes.
    """
    return Corruption(Path(folder), material).repair(progress)
