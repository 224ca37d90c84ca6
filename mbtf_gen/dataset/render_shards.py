"""Renders shards to files: locks claim them, threads sample queries ahead and write shards behind."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Set
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.atomic import Stored, remove_file, write_checksummed
from mbtf_core.locks import Lock, lock_owner, take_lock
from mbtf_core.shard_schema import FORMAT_NAME, SCHEMA_VERSION, ShardEntry
from mbtf_gen.dataset.folder import remove_leftovers
from mbtf_gen.dataset.manifest import plan_digest
from mbtf_gen.dataset.shard_io import write_shard
from mbtf_gen.dataset.shard_statistics import ShardStatistics, refuse_nonfinite
from mbtf_gen.dataset.verify import finished_record, sidecar_of
from mbtf_gen.dataset.writer import ShardWriter
from mbtf_gen.job import Job, most_paths, planned_paths, split_spp, split_target
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries

ProgressCallback = Callable[[float, str], None]


@dataclass(frozen=True)
class Claim:
    """A shard that this process renders, with its lock."""

    entry: ShardEntry
    path: Path
    lock: Lock


class Claims:
    """Locks the shards that are not finished, one at a time; a context manager.

    Leaving the context releases the locks that were not handed over.

    Parameters
    ----------
    entries : the shards to check
    corrupt : files to render again although they seem finished
    skipped : called for every shard that is not claimed, with its sidecar if it is finished

    Attributes
    ----------
    busy : files that other processes render
    """

    def __init__(
        self,
        job: Job,
        folder: Path,
        entries: Iterable[ShardEntry],
        corrupt: Set[str],
        skipped: Callable[[dict[str, Any] | None], None],
    ) -> None:
        self.busy: list[Path] = []
        self._job, self._folder, self._entries = job, folder, entries
        self._skipped = skipped
        # A corrupt shard counts as finished once its sidecar has changed.
        self._stamps = {file: _stamp(folder / file) for file in corrupt}
        self._held: set[Lock] = set()

    def __enter__(self) -> Claims:
        return self

    def __exit__(self, *_: object) -> None:
        for lock in self._held:
            lock.release()
        self._held.clear()

    def hand_over(self, lock: Lock) -> None:
        """Leave the release of a lock to the caller."""
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
                    # Another process may have finished it since.
                    record = self._finished(entry, path)
                    if record is None:
                        yield Claim(entry, path, lock)
                        continue
                    self._held.discard(lock)
                    lock.release()
            self._skipped(record)


def _stamp(path: Path) -> tuple[int, int] | None:
    """Identity of a shard's sidecar, which changes when it is written again; None without one."""
    try:
        found = sidecar_of(path).stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


@dataclass(frozen=True)
class RenderedShard:
    """A rendered shard in memory."""

    entry: ShardEntry
    queries: Queries
    estimates: Estimates
    seconds: float


@dataclass
class RenderResult:
    """Result of :func:`render_shards`.

    Attributes
    ----------
    paths : traced; shards : files that were rendered; busy : files left to other processes
    seconds : duration
    writing : processor seconds of writing and digesting, parallel to the rendering
    waiting : seconds that rendering waited for the writer
    """

    paths: int
    shards: list[str]
    busy: list[Path]
    seconds: float
    writing: float
    waiting: float


def render_shards(
    job: Job,
    folder: Path,
    entries: Iterable[ShardEntry],
    plan: RunPlan,
    *,
    corrupt: Set[str] = frozenset(),
    progress: ProgressCallback | None = None,
) -> RenderResult:
    """Render those of the shards that are not finished.

    Parameters
    ----------
    corrupt : files to render again although they seem finished
    progress : called with (paths so far, note), once per shard; paths count as planned, without the changes
        by a target error or an allocation

    Raises
    ------
    PartialError : the disk is full, or there are too many non-finite samples; finished shards are kept
    """
    start = time.perf_counter()
    total, own = ShardStatistics(), ShardStatistics()
    result = RenderResult(0, [], [], 0.0, 0.0, 0.0)
    records: list[dict[str, Any]] = []
    planned, limit = 0, most_paths(job)

    def report(record: dict[str, Any] | None = None) -> None:
        for done in [*([] if record is None else [record]), *(records.pop() for _ in range(len(records)))]:
            total.add(done)
        if progress is not None:
            rate = result.paths / max(time.perf_counter() - start, 1e-9)
            error = f", noise {total.relative_error():.2%}" if total.train else ""
            progress(planned, f"{rate / 1e6:.2f} M paths/s{error}")

    def store(shard: RenderedShard, path: Path) -> None:
        records.append(store_shard(job, shard, path, plan))

    # Leftovers of killed runs take disk space.
    remove_leftovers(folder)
    estimator: Any = None
    with ExitStack() as stack:
        claims = stack.enter_context(Claims(job, folder, entries, corrupt, report))
        ahead = stack.enter_context(ThreadPoolExecutor(1, "queries"))
        writer = stack.enter_context(ShardWriter())
        for claim, drawn in _one_ahead(claims, ahead, job.query_plan.draw):
            if estimator is None:
                estimator = build_estimator(job, plan.effects)
            began = time.perf_counter()
            queries = drawn.result()
            entry = claim.entry
            stream = Stream(job.config.seed, entry.split, entry.index)
            estimates = estimate_shard(
                estimator,
                queries.flat(),
                split_spp(job.config, entry.split),
                split_target(job.config, entry.split),
                stream,
                plan.allocation,
            )
            shard = RenderedShard(entry, queries, estimates, time.perf_counter() - began)
            writer.submit(partial(store, shard, claim.path), claim.lock.release)
            claims.hand_over(claim.lock)
            result.paths += estimates.paths
            planned += planned_paths(job, [entry])
            result.shards.append(entry.file)
            report()
            own.add_quarantined(entry.file, quarantined(estimates))
            # These shards alone may exceed the limit of the whole data set.
            refuse_nonfinite(own, limit, folder)
    result.busy, result.seconds = claims.busy, time.perf_counter() - start
    result.writing, result.waiting = writer.busy, writer.waited
    return result


def _one_ahead(
    claims: Iterable[Claim], pool: ThreadPoolExecutor, draw: Callable[[str, int, int], Queries]
) -> Iterator[tuple[Claim, Future[Queries]]]:
    """Claims with their queries, which are sampled while the previous shard is rendered."""
    previous: tuple[Claim, Future[Queries]] | None = None
    for claim in claims:
        entry = claim.entry
        drawn = pool.submit(draw, entry.split, entry.index, entry.rows)
        if previous is not None:
            yield previous
        previous = claim, drawn
    if previous is not None:
        yield previous


def store_shard(job: Job, shard: RenderedShard, path: Path, plan: RunPlan) -> dict[str, Any]:
    """Write a shard and its sidecar; returns the sidecar."""
    # If the run is killed between the two, an old sidecar would mark the new shard as finished.
    remove_file(sidecar_of(path))
    queries, estimates = shard.queries, shard.estimates
    lead, through = queries.lead, estimates.transmittance
    spp = split_spp(job.config, shard.entry.split) if estimates.spp is None else estimates.spp.reshape(lead)
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
    record = sidecar(job, shard, path.name, stored, plan)
    write_checksummed(sidecar_of(path), record)
    return record


def quarantined(estimates: Estimates) -> dict[str, Any]:
    """A sidecar's record of samples that are not stored."""
    return {
        "nonfinite_samples": estimates.nonfinite,
        "lost_rays": estimates.lost,
        "capped_rays": estimates.capped,
        "nonfinite_at": [asdict(bad) for bad in estimates.bad_samples],
    }


def sidecar(job: Job, shard: RenderedShard, file: str, stored: Stored, plan: RunPlan) -> dict[str, Any]:
    """Content of a shard's sidecar."""
    entry, estimates = shard.entry, shard.estimates
    a, b = estimates.value_a, estimates.value_b
    difference = (a - b).astype(np.float64)
    return {
        "format": FORMAT_NAME,
        "schema": SCHEMA_VERSION,
        "config_hash": job.config_hash,
        "plan": plan_digest(plan.to_manifest()),
        "file": file,
        "split": entry.split,
        "index": entry.index,
        "rows": entry.rows,
        "bytes": stored.bytes,
        "sha256": stored.sha256,
        "seed": {"root": job.config.seed, "split": entry.split, "shard": entry.index},
        "spp": split_spp(job.config, entry.split),
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
    """Message about shards that other processes write: their number, and the writer of the first."""
    owner = lock_owner(busy[0])
    who = "" if owner is None else f" ({owner})"
    return f"{len(busy)} shard(s) are being written by another process, first {busy[0].name}{who}"
