"""Makes again what ``verify`` condemns, and nothing else.

What the data set is, its manifest says. Where that is damaged too, sidecars bear witness: each carries the
hash of the configuration and the digest of the effects plan, so that a manifest made anew from
``config.yaml`` and the material is known to be the lost one, or refused.
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
from mbtf_core.errors import InputError, MbtfError, PartialError
from mbtf_core.locks import brief_lock
from mbtf_core.shard_schema import CONFIG_NAME, FORMAT_NAME, MANIFEST_NAME, SPLITS
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset.manifest import ShardEntry, build_manifest, effects_digest
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.render_shards import ProgressCallback, busy_message, make_shards
from mbtf_gen.dataset.summary import finish, planned_effects
from mbtf_gen.dataset.verify import Fault, shard_faults, verify
from mbtf_gen.generation import Job, plan_run
from mbtf_gen.planning.effects import EffectsPlan

_AGAIN = "generate the data set again, into another folder"


@dataclass(frozen=True)
class RepairResult:
    """What a repair did.

    Attributes
    ----------
    shards : files made again; documents : manifest and configuration, where they were written again
    left : faults that are not ours to mend: files that the manifest does not list
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
    """What is wrong with a data set and how it is mended; :meth:`mend` does it.

    Parameters
    ----------
    folder : the data set's
    material : where its material lies now; by default where it lay when the data set was made

    Raises
    ------
    InputError : no data set there
    """

    folder: Path
    material: str | None = None

    def __post_init__(self) -> None:
        if not self.folder.is_dir():
            raise InputError("no such folder", where=self.folder)
        if not (self.folder / MANIFEST_NAME).exists() and self._witness[0] is None:
            Dataset.open(self.folder)

    @cached_property
    def faults(self) -> list[Fault]:
        """What :func:`verify` finds; of a data set whose manifest cannot be read, that."""
        try:
            return verify(self.folder)
        except InputError as error:
            return [Fault(MANIFEST_NAME, error.what, _AGAIN)]

    @cached_property
    def _manifest(self) -> dict[str, Any] | None:
        """The manifest, if it is as it was written."""
        try:
            return read_checksummed(self.folder / MANIFEST_NAME)
        except InputError:
            return None

    @cached_property
    def _witness(self) -> tuple[str | None, str | None]:
        """Hash of the configuration and digest of the effects plan, as most of the intact sidecars say."""
        seen: Counter[tuple[str, str]] = Counter()
        for path in self.folder.glob("*-*.json"):
            try:
                record = read_checksummed(path)
            except InputError:
                continue
            if record.get("format") == FORMAT_NAME:
                seen[str(record.get("config_hash")), str(record.get("effects"))] += 1
        return seen.most_common(1)[0][0] if seen else (None, None)

    def _configurations(self) -> Iterator[GeneratorConfig]:
        """Configurations that are still legible, the manifest's first."""
        stored: list[Any] = []
        for path in (self.folder / MANIFEST_NAME, self.folder / CONFIG_NAME):
            try:
                stored.append(read_json(path)["config"] if path.name == MANIFEST_NAME else read_yaml(path))
            except (MbtfError, KeyError):
                continue
        for number, data in enumerate(stored):
            if data in stored[:number]:
                continue
            try:
                config = GeneratorConfig.model_validate(data)
            except ValidationError:
                continue
            yield config.model_copy(update={"material": self.material}) if self.material else config

    @cached_property
    def job(self) -> Job:
        """The configuration that made the data set, with its material.

        Raises
        ------
        InputError : there is no telling, or the material is gone or another one by now
        """
        wanted = self._witness[0] if self._manifest is None else self._manifest["config_hash"]
        if wanted is None:
            raise InputError(
                "cannot be restored: no other file of the folder says what it held",
                where=self.folder / MANIFEST_NAME,
                hint=_AGAIN,
            )
        other: Job | None = None
        for config in self._configurations():
            if not Path(config.material).exists():
                raise InputError(
                    f"the material is not at '{config.material}'",
                    where=self.folder,
                    hint="name it with: mbtf-gen repair FOLDER --material PATH",
                )
            job = Job.prepare(config)
            if job.config_hash == wanted:
                return job
            other = other or job
        raise self._refusal(other)

    def _refusal(self, job: Job | None) -> InputError:
        if job is None:
            return InputError(
                f"neither {MANIFEST_NAME} nor {CONFIG_NAME} can be read", where=self.folder, hint=_AGAIN
            )
        then = (self._manifest or {}).get("inputs", {})
        changes = in_short(differences(then, dict(sorted(job.material.digests.items()))))
        what = f" ({changes})" if then and changes else ""
        return InputError(
            f"the material or the configuration is not the one that made the data set{what}",
            where=self.folder,
            hint="bring it back, or generate the data set again",
        )

    @cached_property
    def effects(self) -> EffectsPlan:
        """The effects plan that the data set was made with.

        Raises
        ------
        InputError : it is lost
        """
        if self._manifest is not None:
            return planned_effects(self.folder)
        plan = plan_run(self.job)
        if effects_digest(plan.to_manifest()) != self._witness[1]:
            raise InputError(
                "cannot be restored: the effects plan comes out otherwise here",
                where=self.folder / MANIFEST_NAME,
                hint="repair it on the machine that made it, or generate the data set again",
            )
        return plan

    @cached_property
    def documents(self) -> list[str]:
        """Manifest and configuration, where they have to be written again."""
        names = {f.file for f in self.faults if f.file in (MANIFEST_NAME, CONFIG_NAME) and not f.unfinished}
        if self._manifest is None or any(f.listing for f in self.faults):
            names.add(MANIFEST_NAME)
        return sorted(names, reverse=True)

    @cached_property
    def entries(self) -> list[ShardEntry]:
        """Shards that have to be made again, or are not there yet."""
        every = [e for split in SPLITS for e in self.job.shards(split)]
        condemned = {f.file for f in self._shard_faults()}
        return [e for e in every if e.file in condemned]

    @cached_property
    def left(self) -> list[Fault]:
        """Faults that are not ours to mend."""
        return [f for f in self.faults if f.unlisted]

    def _shard_faults(self) -> list[Fault]:
        """Faults of shards; where the manifest was no help in finding them, those of the restored one."""
        if self._manifest is not None:
            return [f for f in self.faults if not (f.unlisted or f.listing)]
        every = [e for split in SPLITS for e in self.job.shards(split)]
        return list(shard_faults(self.folder, every, self.job.config_hash, str(self._witness[1])))

    @property
    def paths(self) -> int:
        """Paths that mending takes."""
        return sum(self.job.paths(entry) for entry in self.entries)

    def mend(self, progress: ProgressCallback | None = None) -> RepairResult:
        """Write the documents and make the shards again.

        Raises
        ------
        InputError : see :attr:`job` and :attr:`effects`
        PartialError : others are writing, the disk is full; the same command goes on
        """
        documents, entries, effects = self.documents, self.entries, self.effects
        if documents or entries:
            self._write_documents(documents, bool(entries))
        made = make_shards(
            self.job,
            self.folder,
            entries,
            effects,
            condemned={e.file for e in entries},
            progress=progress,
        )
        if made.busy:
            raise PartialError(
                busy_message(made.busy),
                where=self.folder,
                hint="wait for it, then run the same command again",
            )
        summary = finish(self.folder)
        return RepairResult(
            str(self.folder),
            self.faults,
            made.shards,
            documents,
            self.left,
            summary.complete,
            made.paths,
            round(made.seconds, 3),
        )

    def _write_documents(self, documents: list[str], unfinished: bool) -> None:
        path = self.folder / MANIFEST_NAME
        with brief_lock(path):
            if MANIFEST_NAME in documents:
                every = [e for split in SPLITS for e in self.job.shards(split)]
                write_checksummed(path, build_manifest(self.job, every, self.effects))
            manifest = read_checksummed(path)
            if unfinished and manifest["complete"]:
                # Readers trust this word, and shards are about to go.
                write_checksummed(path, {**manifest, "complete": False, "summary": None})
            if CONFIG_NAME in documents:
                write_text(self.folder / CONFIG_NAME, dump_yaml(manifest["config"]))


def repair(
    folder: str | Path, *, material: str | None = None, progress: ProgressCallback | None = None
) -> RepairResult:
    """Make again what ``verify`` condemns (``mbtf-gen repair``): the data set is then the undisturbed one.

    Parameters
    ----------
    material : where the material lies now; by default where it lay when the data set was made
    progress : called with (paths traced so far, note)

    Raises
    ------
    InputError : no data set there, or its material is gone or has changed
    PartialError : others are writing, the disk is full; the same command goes on
    """
    return Corruption(Path(folder), material).mend(progress)
