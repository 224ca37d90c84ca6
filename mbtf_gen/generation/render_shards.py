"""Renders shards to files: locks claim them, threads sample queries ahead and write shards behind."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from mbtf_core.data.folder import DataFolder
from mbtf_core.data.manifest import plan_digest
from mbtf_core.data.queries import Queries
from mbtf_core.data.schema import ShardEntry
from mbtf_core.data.shard_files import write_shard
from mbtf_core.data.sidecar import finished_record, sidecar, upload_waiting
from mbtf_core.errors import InputError, PartialError
from mbtf_core.files.atomic import Stored
from mbtf_core.locks import Lock, lock_owner, take_lock
from mbtf_gen.generation.summary import ShardStatistics, refuse_nonfinite
from mbtf_gen.job import Job, most_paths, planned_paths, split_spp, split_target
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream

# Called with the paths so far, a note, and the paths expected in all (None: not known yet).
ProgressCallback = Callable[[float, str, float | None], None]
# Shards that are being written or wait for it while others are rendered.
_WAITING = 2


@dataclass(frozen=True)
class _Claim:
    """A shard that this process renders, with its lock and its queries, which a thread samples."""

    entry: ShardEntry
    lock: Lock
    queries: Future[Queries]


class ExpectedPaths:
    """Paths of shards to come. A target error or an allocation changes the planned number; it is corrected by
    the ratio of traced and planned paths of the shards so far, by split."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._planned: Counter[str] = Counter()
        self._traced: Counter[str] = Counter()

    def add(self, entry: ShardEntry, paths: int) -> None:
        self._planned[entry.split] += planned_paths(self._job, [entry])
        self._traced[entry.split] += paths

    def paths(self, entries: Iterable[ShardEntry]) -> float | None:
        """None where a target error decides, and no shard is done."""
        total = 0.0
        for entry in entries:
            ratio = 1.0
            if done := self._planned[entry.split]:
                ratio = self._traced[entry.split] / done
            elif split_target(self._job.config, entry.split) is not None:
                return None
            total += ratio * planned_paths(self._job, [entry])
        return round(total)


def progress_of(
    paths: int, seconds: float, totals: ShardStatistics, left: float | None, where: str = ""
) -> tuple[float, str, float | None]:
    """Arguments of a :data:`ProgressCallback`: `paths` traced in `seconds`, `left` to come, by whom."""
    noise = totals.relative_error() if totals.train else None
    error = "" if noise is None else f", noise {noise:.2%}"
    note = f"{paths / max(seconds, 1e-9) / 1e6:.2f} M paths/s{where}{error}"
    return paths, note, None if left is None else paths + left


@dataclass
class RenderResult:
    """Result of :func:`render_shards`.

    Attributes
    ----------
    paths : traced; shards : files that were rendered
    seconds : duration since the start of the run
    writing : processor seconds of writing and digesting, parallel to the rendering
    waiting : seconds that rendering waited for the writer
    """

    paths: int = 0
    shards: list[str] = field(default_factory=list)
    seconds: float = 0.0
    writing: float = 0.0
    waiting: float = 0.0


def render_shards(
    job: Job,
    folder: DataFolder,
    entries: Iterable[ShardEntry],
    plan: RunPlan,
    *,
    start: float | None = None,
    progress: ProgressCallback | None = None,
) -> RenderResult:
    """Render those of the shards that are not finished.

    Parameters
    ----------
    start : when the run began, by ``time.perf_counter``; now by default. Seconds and paths per second count
        from it
    progress : called once per shard

    Raises
    ------
    PartialError : other processes render some of them, the disk is full, the store cannot be reached, or
        there are too many non-finite samples; finished shards are kept
    """
    start = time.perf_counter() if start is None else start
    pending = {entry.file: entry for entry in entries}
    expected = ExpectedPaths(job)
    total, own = ShardStatistics(), ShardStatistics()
    result = RenderResult()
    records: list[dict[str, Any]] = []
    limit = most_paths(job)

    def skip(entry: ShardEntry, record: dict[str, Any] | None) -> None:
        if record is not None:
            del pending[entry.file]
        report(record)

    def report(record: dict[str, Any] | None = None) -> None:
        for done in [*([] if record is None else [record]), *(records.pop() for _ in range(len(records)))]:
            total.add(done)
        if progress is not None:
            seconds, left = time.perf_counter() - start, expected.paths(pending.values())
            progress(*progress_of(result.paths, seconds, total, left))

    unsent: list[PartialError | InputError] = []

    def store(claim: _Claim, *rendered: Any) -> None:
        began = time.thread_time()
        try:
            records.append(store_shard(job, folder, plan, claim.entry, *rendered))
        except (PartialError, InputError) as error:
            # What is rendered meanwhile is still written, and uploaded by the next run.
            unsent.append(error)
        finally:
            claim.lock.release()
            result.writing += time.thread_time() - began

    writes: deque[Future[None]] = deque()

    def wait_for_writes(most: int) -> None:
        """Wait until at most so many shards are not written yet."""
        began = time.perf_counter()
        while len(writes) > most:
            writes.popleft().result()
        result.waiting += time.perf_counter() - began

    # Leftovers of killed runs take disk space.
    folder.remove_leftovers()
    upload_waiting(folder, job.shards, job.config_hash, plan_digest(plan.to_manifest()))
    estimator: Any = None
    # Shards of other processes are tried again after the own ones: the process that ends last leaves none.
    while pending:
        tried, busy = [*pending.values()], list[ShardEntry]()
        with ExitStack() as stack:
            ahead = stack.enter_context(ThreadPoolExecutor(1, "queries"))
            claims = stack.enter_context(closing(_claims(job, folder, tried, ahead, busy, skip)))
            # Its exit waits, also after an interruption, so that no rendered shard is lost.
            writer = stack.enter_context(ThreadPoolExecutor(1, "shard writer"))
            for claim in claims:
                if estimator is None:
                    estimator = build_estimator(job, plan.effects)
                began = time.perf_counter()
                queries, entry = claim.queries.result(), claim.entry
                estimates = estimate_queries(job, plan, estimator, entry, queries)
                seconds = time.perf_counter() - began
                writes.append(writer.submit(store, claim, queries, estimates, seconds))
                wait_for_writes(_WAITING)
                result.paths += estimates.paths
                expected.add(pending.pop(entry.file), estimates.paths)
                result.shards.append(entry.file)
                report()
                own.add_quarantined(entry.file, _quarantined(estimates))
                # These shards alone may exceed the limit of the whole data set.
                refuse_nonfinite(own, limit, folder)
                if unsent:
                    break
            wait_for_writes(0)
        if unsent:
            raise unsent[0]
        if len(busy) == len(tried):
            owner = lock_owner(folder.workspace / busy[0].file)
            who = "" if owner is None else f" ({owner})"
            raise PartialError(
                f"{len(busy)} shard(s) are being written by another process, first {busy[0].file}{who}",
                where=folder,
                hint="wait for it, then run the same command again",
            )
    result.seconds = time.perf_counter() - start
    return result


def _claims(
    job: Job,
    folder: DataFolder,
    entries: Iterable[ShardEntry],
    pool: ThreadPoolExecutor,
    busy: list[ShardEntry],
    skipped: Callable[[ShardEntry, dict[str, Any] | None], None],
) -> Generator[_Claim]:
    """Lock the shards that are not finished, one ahead of the caller, so that their queries are sampled while
    the previous shard is rendered.

    The caller must have handed a lock over when it asks for the next claim; closing the generator releases
    the others. Shards that other processes render go to `busy`. `skipped` is called for every shard that is
    not claimed, with its sidecar if it is finished.
    """

    held: deque[_Claim] = deque()
    try:
        for entry in entries:
            record = finished_record(folder, entry, job.config_hash)
            lock = take_lock(folder.workspace / entry.file) if record is None else None
            if record is None and lock is None:
                busy.append(entry)
            elif lock is not None:
                # Another process may have finished it since.
                record = finished_record(folder, entry, job.config_hash)
                if record is None:
                    drawn = pool.submit(job.query_plan.draw, entry.split, entry.index, entry.rows)
                    held.append(_Claim(entry, lock, drawn))
                    if len(held) > 1:
                        yield held[0]
                        held.popleft()
                    continue
                lock.release()
            skipped(entry, record)
        while held:
            yield held[0]
            held.popleft()
    finally:
        for claim in held:
            claim.lock.release()


def estimate_queries(
    job: Job, plan: RunPlan, estimator: Any, entry: ShardEntry, queries: Queries
) -> Estimates:
    """Both halves of the queries of a shard; they depend on seed, split and index, not on the process."""
    return estimate_shard(
        estimator,
        queries.flat(),
        split_spp(job.config, entry.split),
        split_target(job.config, entry.split),
        Stream(job.config.seed, entry.split, entry.index),
        plan.allocation,
    )


def store_shard(
    job: Job,
    folder: DataFolder,
    plan: RunPlan,
    entry: ShardEntry,
    queries: Queries,
    estimates: Estimates,
    seconds: float,
) -> dict[str, Any]:
    """Write a rendered shard and its sidecar; returns the sidecar. Errors are those of
    :meth:`~mbtf_core.data.folder.DataFolder.write_shard`."""
    lead, through = queries.lead, estimates.transmittance
    a, b = estimates.value_a, estimates.value_b
    planned = split_spp(job.config, entry.split)
    spp = planned if estimates.spp is None else estimates.spp.reshape(lead)
    arrays = {
        **vars(queries),
        "value_a": a.reshape(*lead, 3),
        "value_b": b.reshape(*lead, 3),
        "spp": np.broadcast_to(np.asarray(spp, np.float32), lead).copy(),
        **({} if through is None else {"transmittance": through.reshape(lead)}),
    }

    def record(stored: Stored) -> dict[str, Any]:
        return sidecar(
            entry,
            stored,
            config_hash=job.config_hash,
            plan=plan_digest(plan.to_manifest()),
            seed=job.config.seed,
            spp=planned,
            queries=len(a),
            paths=estimates.paths,
            seconds=round(seconds, 4),
            quarantined=_quarantined(estimates),
            target=None if estimates.target is None else asdict(estimates.target),
            mean_value=(0.5 * sum(half.mean(axis=0, dtype=np.float64) for half in (a, b))).tolist(),
            mean_variance=(0.25 * np.square((a - b).astype(np.float64)).mean(axis=0)).tolist(),
        )

    return folder.write_shard(entry.file, lambda path: write_shard(path, arrays), record)


def _quarantined(estimates: Estimates) -> dict[str, Any]:
    """A sidecar's record of samples that are not stored."""
    return {
        "nonfinite_samples": estimates.nonfinite,
        "lost_rays": estimates.lost,
        "capped_rays": estimates.capped,
        "nonfinite_at": [asdict(bad) for bad in estimates.bad_samples],
    }
