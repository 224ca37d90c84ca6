"""From a list of shards to files: claimed by locks, drawn ahead, rendered, written behind."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Set
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_core.atomic import Stored, remove_file, write_checksummed
from mbtf_core.locks import Lock, lock_owner, take_lock
from mbtf_core.shard_schema import FORMAT_NAME, SCHEMA_VERSION
from mbtf_gen.dataset.folder import sweep
from mbtf_gen.dataset.manifest import ShardEntry, effects_digest
from mbtf_gen.dataset.shard_io import write_shard
from mbtf_gen.dataset.shard_statistics import ShardStatistics, refuse_nonfinite
from mbtf_gen.dataset.verify import finished_record, sidecar_of
from mbtf_gen.dataset.writer import ShardWriter
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.effects import EffectsPlan
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries

if TYPE_CHECKING:
    from mbtf_gen.generation import Job

ProgressCallback = Callable[[float, str], None]


@dataclass(frozen=True)
class Claim:
    """A shard that is ours to make."""

    entry: ShardEntry
    path: Path
    lock: Lock


class Claims:
    """Takes the locks of the shards that have to be made, one at a time; a context manager.

    Leaving the context releases those that were not handed on.

    Parameters
    ----------
    entries : the shards to look at
    condemned : files to make again although they pass for finished
    skipped : called for every shard that is not claimed, with its sidecar where it is finished

    Attributes
    ----------
    busy : files that other processes were making
    """

    def __init__(
        self,
        job: Job,
        folder: Path,
        entries: Iterable[ShardEntry],
        condemned: Set[str],
        skipped: Callable[[dict[str, Any] | None], None],
    ) -> None:
        self.busy: list[Path] = []
        self._job, self._folder, self._entries = job, folder, entries
        self._skipped = skipped
        # What is condemned is another one once somebody has made it again.
        self._stamps = {file: _stamp(folder / file) for file in condemned}
        self._held: set[Lock] = set()

    def __enter__(self) -> Claims:
        return self

    def __exit__(self, *_: object) -> None:
        for lock in self._held:
            lock.release()
        self._held.clear()

    def hand_on(self, lock: Lock) -> None:
        """Leave a lock's release to somebody else."""
        self._held.discard(lock)

    def _finished(self, entry: ShardEntry, path: Path) -> dict[str, Any] | None:
        if entry.file in self._stamps and self._stamps[entry.file] == _stamp(path):
            return None
        return finished_record(path, entry.rows, self._job.config_hash)

    def __iter__(self) -> Iterator[Claim]:
        for entry in self._entries:
            path = self._folder / entry.file
            record = self._finished(entry, path)
            if record is None:
                lock = take_lock(path)
                if lock is None:
                    self.busy.append(path)
                else:
                    self._held.add(lock)
                    # Another process may have made it since.
                    record = self._finished(entry, path)
                    if record is None:
                        yield Claim(entry, path, lock)
                        continue
                    self._held.discard(lock)
                    lock.release()
            self._skipped(record)


def _stamp(path: Path) -> tuple[int, int] | None:
    """What tells a sidecar from one that was written later; None without one."""
    try:
        found = sidecar_of(path).stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


@dataclass(frozen=True)
class RenderedShard:
    """A shard that is to be written."""

    entry: ShardEntry
    queries: Queries
    estimates: Estimates
    seconds: float


@dataclass
class RenderResult:
    """What :func:`make_shards` did.

    Attributes
    ----------
    paths : traced; shards : their files; busy : files left to other processes
    seconds : in all
    writing : processor seconds that writing and digesting took beside the rendering
    waiting : seconds that rendering waited for it
    """

    paths: int
    shards: list[str]
    busy: list[Path]
    seconds: float
    writing: float
    waiting: float


def make_shards(
    job: Job,
    folder: Path,
    entries: Iterable[ShardEntry],
    effects: EffectsPlan,
    *,
    condemned: Set[str] = frozenset(),
    progress: ProgressCallback | None = None,
) -> RenderResult:
    """Make those of the shards that are not finished.

    Parameters
    ----------
    condemned : files to make again although they pass for finished
    progress : called with (paths so far, note), once per shard; counted as planned, whatever a target error
        or an allocation made of them

    Raises
    ------
    PartialError : the disk is full, or there are too many non-finite samples; what was finished is kept
    """
    start = time.perf_counter()
    reached, mine = ShardStatistics(), ShardStatistics()
    made = RenderResult(0, [], [], 0.0, 0.0, 0.0)
    records: list[dict[str, Any]] = []
    planned, everything = 0, job.most_paths()

    def report(record: dict[str, Any] | None = None) -> None:
        for done in [*([] if record is None else [record]), *(records.pop() for _ in range(len(records)))]:
            reached.add(done)
        if progress is not None:
            rate = made.paths / max(time.perf_counter() - start, 1e-9)
            error = f", noise {reached.relative_error():.2%}" if reached.train else ""
            progress(planned, f"{rate / 1e6:.2f} M paths/s{error}")

    def store(shard: RenderedShard, path: Path) -> None:
        records.append(store_shard(job, shard, path, effects))

    # What killed runs left takes room that may be wanting.
    sweep(folder)
    plan = job.plan()
    estimator: Any = None
    with ExitStack() as stack:
        claims = stack.enter_context(Claims(job, folder, entries, condemned, report))
        ahead = stack.enter_context(ThreadPoolExecutor(1, "queries"))
        writer = stack.enter_context(ShardWriter())
        for claim, drawn in _one_ahead(claims, ahead, plan.draw):
            if estimator is None:
                estimator = job.estimator(effects)
            began = time.perf_counter()
            queries = drawn.result()
            entry = claim.entry
            stream = Stream(job.config.seed, entry.split, entry.index)
            estimates = estimate_shard(
                estimator, queries.flat(), job.spp(entry.split), job.target(entry.split), stream, effects
            )
            shard = RenderedShard(entry, queries, estimates, time.perf_counter() - began)
            writer.submit(partial(store, shard, claim.path), claim.lock.release)
            claims.hand_on(claim.lock)
            made.paths += estimates.paths
            planned += job.paths(entry)
            made.shards.append(entry.file)
            report()
            mine.add_quarantined(entry.file, quarantined(estimates))
            # More than the whole data set may have: the rest cannot mend that.
            refuse_nonfinite(mine, everything, folder)
    made.busy, made.seconds = claims.busy, time.perf_counter() - start
    made.writing, made.waiting = writer.busy, writer.waited
    return made


def _one_ahead(
    claims: Iterable[Claim], pool: ThreadPoolExecutor, draw: Callable[[str, int, int], Queries]
) -> Iterator[tuple[Claim, Future[Queries]]]:
    """Claims with their queries, which are drawn while the shard before is rendered."""
    previous: tuple[Claim, Future[Queries]] | None = None
    for claim in claims:
        entry = claim.entry
        drawn = pool.submit(draw, entry.split, entry.index, entry.rows)
        if previous is not None:
            yield previous
        previous = claim, drawn
    if previous is not None:
        yield previous


def store_shard(job: Job, shard: RenderedShard, path: Path, effects: EffectsPlan) -> dict[str, Any]:
    """Write a shard and its sidecar; returns the sidecar."""
    # A sidecar of before would vouch for the new file if this run were killed between the two.
    remove_file(sidecar_of(path))
    queries, estimates = shard.queries, shard.estimates
    lead, through = queries.lead, estimates.transmittance
    spp = job.spp(shard.entry.split) if estimates.spp is None else estimates.spp.reshape(lead)
    stored = write_shard(
        path,
        {
            "u": queries.u,
            "sigma": queries.sigma,
            "omega_i": queries.omega_i,
            "omega_o": queries.omega_o,
            "value_a": estimates.value_a.reshape(*lead, 3),
            "value_b": estimates.value_b.reshape(*lead, 3),
            "spp": np.broadcast_to(np.asarray(spp, np.float32), lead).copy(),
            **({} if through is None else {"transmittance": through.reshape(lead)}),
        },
    )
    record = sidecar(job, shard, path.name, stored, effects)
    write_checksummed(sidecar_of(path), record)
    return record


def quarantined(estimates: Estimates) -> dict[str, Any]:
    """What a sidecar says of samples that were not stored."""
    return {
        "nonfinite_samples": estimates.nonfinite,
        "lost_rays": estimates.lost,
        "capped_rays": estimates.capped,
        "nonfinite_at": [asdict(bad) for bad in estimates.bad_samples],
    }


def sidecar(
    job: Job, shard: RenderedShard, file: str, stored: Stored, effects: EffectsPlan
) -> dict[str, Any]:
    """Content of a shard's sidecar."""
    entry, estimates = shard.entry, shard.estimates
    a, b = estimates.value_a, estimates.value_b
    difference = (a - b).astype(np.float64)
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "config_hash": job.config_hash,
        "effects": effects_digest(effects.to_manifest()),
        "file": file,
        "split": entry.split,
        "index": entry.index,
        "rows": entry.rows,
        "bytes": stored.bytes,
        "sha256": stored.sha256,
        "seed": {"root": job.config.seed, "split": entry.split, "shard": entry.index},
        "spp": job.spp(entry.split),
        "queries": len(a),
        "paths": estimates.paths,
        "seconds": round(shard.seconds, 4),
        "quarantined": quarantined(estimates),
        "target": None if estimates.target is None else asdict(estimates.target),
        "statistics": {
            "mean_value": (0.5 * sum(half.mean(axis=0, dtype=np.float64) for half in (a, b))).tolist(),
            "mean_variance": (0.25 * np.square(difference).mean(axis=0)).tolist(),
        },
    }


def busy_message(busy: list[Path]) -> str:
    """Shards that other processes write: how many, and who writes the first."""
    owner = lock_owner(busy[0])
    who = "" if owner is None else f" ({owner})"
    return f"{len(busy)} shard(s) are being written by another process, first {busy[0].name}{who}"
