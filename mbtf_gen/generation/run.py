"""Generates a data set from a configuration: a folder of shards. Resumes an unfinished one.

A task is a shard, done when its sidecar is there; a lock claims it. In this process, threads sample queries
ahead and write shards behind.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.documents import finished_record, plan_digest, upload_waiting
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import MANIFEST_NAME, Queries, ShardEntry
from mbtf_core.errors import InputError, LockedError, PartialError, UsageError, check_type
from mbtf_core.files.locks import lock_owner, take_lock
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, Result
from mbtf_core.units import rate_text
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import has_dataset, open_folder, read_run_plan
from mbtf_gen.generation.manifest import Summary, finish
from mbtf_gen.generation.shard_record import ShardStatistics, store_shard
from mbtf_gen.planning.adaptive import estimate_shard
from mbtf_gen.planning.job import (
    Job,
    most_paths,
    planned_paths,
    received_job,
    split_lights,
    split_spp,
    split_target,
)
from mbtf_gen.planning.run_plan import RunPlan, plan_run
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream

# Called with the paths so far, a note (the phase, or the rate), and the paths expected in all (None: not
# known yet).
ProgressCallback = Callable[[float, str, float | None], None]

# Failures in a row of workers after which the other shards are not tried: the disk is full.
_FAILURES = 8


def unfinished(
    job: Job,
    folder: str | Path | DataFolder,
    slice_index: int = 1,
    slice_count: int = 1,
    overwrite: bool = False,
) -> list[ShardEntry]:
    """Shards of a slice that :func:`generate` has yet to render."""
    entries = job.shards[slice_index - 1 :: slice_count]
    found = folder if isinstance(folder, DataFolder) else DataFolder.open(folder)
    return [e for e in entries if overwrite or not finished_record(found, e, job.config_hash)]


def generate(
    source: GeneratorConfig | Job,
    folder: str | Path | DataFolder,
    *,
    overwrite: bool = False,
    slice_index: int = 1,
    slice_count: int = 1,
    progress: ProgressCallback | None = None,
    runner: Runner | None = None,
) -> Summary:
    """Generate a data set, or finish an unfinished one.

    All shards follow the plan in the folder's manifest, whichever machine renders them.

    Parameters
    ----------
    source : GeneratorConfig or Job
        The configuration, or the job of one whose material is loaded already. Notes and warnings about the
        material of a configuration are logged.
    folder : str, Path or DataFolder
        Output folder, or a URL such as ``s3://bucket/data``. An unfinished data set of the same configuration
        is resumed.
    overwrite : bool
        Replace the folder's data set. With several slices, a data set of the same configuration is kept,
        because another slice may have begun it.
    slice_index, slice_count : int
        Generate every `slice_count`-th shard only, starting with number `slice_index`, from 1.
    progress : callable, optional
        Called at the begin of each phase, and after every launch of this process and every shard, with the
        paths of this run so far, a note, and the paths that the run is expected to trace (None where a
        target error leaves it open).
    runner : Runner, optional
        Renders the shards, with the same values wherever; in this process by default.

    Returns
    -------
    Summary
        Of the data set as it is now.

    Raises
    ------
    InputError
        Material or folder cannot be used.
    UsageError
        An argument is of another type or out of range.
    PartialError
        Other processes render some of the shards, the disk is full, the store cannot be reached, or too many
        samples are non-finite. The same command resumes.
    """
    check_type(source, (GeneratorConfig, Job), "source", "such as GeneratorConfig(material='heights.exr')")
    if not 1 <= slice_index <= slice_count:
        what = f"is {slice_index} of {slice_count}, but must be from 1 to slice_count"
        raise UsageError(what, where="slice_index")
    folder = DataFolder.open(folder)
    start = time.perf_counter()
    job = source if isinstance(source, Job) else Job.load(source)
    if job is not source:
        job.announce()
    overwrite = overwrite and not (slice_count > 1 and has_dataset(folder, job.config_hash))

    def note(phase: str) -> None:
        if progress is not None:
            progress(0.0, phase, None)

    plan = open_folder(job, folder, lambda job: plan_run(job, note), overwrite)
    entries = unfinished(job, folder, slice_index, slice_count)
    run = ShardRun(job, folder, plan)
    paths = render_shards(run, entries, runner or Runner(), progress=progress)
    summary = finish(folder, paths=paths, seconds=time.perf_counter() - start)
    if slice_count == 1 and not summary.complete:
        raise PartialError(
            "finished shards are missing or cannot be read",
            where=folder,
            hint="run the same command again",
        )
    return summary


class ShardRun:
    """What the shards of a run share, built once in each process.

    Pickled, it is its job, its folder and the digest of its plan: a worker reads the plan from the manifest
    that it sees, and writes into the folder itself. The process that sent a `received` run gives a shard to
    one worker alone.
    """

    def __init__(self, job: Job, folder: DataFolder, plan: RunPlan, received: bool = False) -> None:
        self.job, self.folder, self.plan, self.received = job, folder, plan, received
        # Called with the paths of each launch of this process.
        self.observe: Callable[[int], None] = lambda paths: None
        self.digest = plan_digest(plan.to_manifest())

    def __reduce__(self) -> tuple[Any, ...]:
        local = self.folder.local
        folder = str(self.folder) if local is None else os.path.abspath(local)
        return received_run, (*self.job.__reduce__()[1], folder, self.digest)

    @cached_property
    def estimator(self) -> Any:
        """Built where a shard is to be rendered."""
        return build_estimator(self.job, self.plan.effects)

    def finished(self, entry: ShardEntry) -> dict[str, Any] | None:
        """Sidecar of a finished shard."""
        record = finished_record(self.folder, entry, self.job.config_hash)
        if record is None or not self.received or self.folder.local is not None:
            return record
        # The store is listed again: the shard may have been removed since this worker saw it there.
        self.folder.refresh()
        return finished_record(self.folder, entry, self.job.config_hash)

    def draw(self, entry: ShardEntry) -> tuple[Queries, NDArray[np.float32] | None]:
        """Queries of a shard, and their weights where they have any."""
        plan, highlights = self.job.query_plan, self.plan.highlights
        if entry.split == "train" or highlights is None:
            return plan.draw(entry.split, entry.index, entry.rows), None
        return highlights.draw(plan, entry.index, entry.rows)

    def store(
        self,
        entry: ShardEntry,
        queries: Queries,
        estimates: Estimates,
        seconds: float,
        weight: NDArray[np.float32] | None = None,
    ) -> dict[str, Any]:
        """Write a shard and its sidecar, which is returned."""
        lead, through = queries.lead, estimates.transmittance
        planned = split_spp(self.job.config, entry.split)
        spp = planned if estimates.spp is None else estimates.spp.reshape(lead)
        arrays = {
            **vars(queries),
            "value_a": estimates.value_a.reshape(*lead, 3),
            "value_b": estimates.value_b.reshape(*lead, 3),
            "spp": np.broadcast_to(np.asarray(spp, np.float32), lead).copy(),
            **({} if through is None else {"transmittance": through.reshape(lead)}),
            **({} if weight is None else {"weight": weight}),
        }
        digests, seed = (self.job.config_hash, self.digest), self.job.config.seed
        return store_shard(
            self.folder, entry, arrays, *digests, seed, spp=planned, estimates=estimates, seconds=seconds
        )


@lru_cache(maxsize=1)
def received_run(config: str, config_hash: str, folder: str, digest: str) -> ShardRun:
    """The run of another process, kept for its next shard; an InputError if this machine does not see the
    folder or the material, or has others of them."""
    found = DataFolder.open(folder)
    if not found.has(MANIFEST_NAME):
        raise InputError("this machine does not see the data set", where=folder)
    run = ShardRun(received_job(config, config_hash), found, read_run_plan(found), received=True)
    if run.digest != digest:
        raise InputError("the manifest has another plan on this machine", where=folder)
    return run


def render_shard(run: ShardRun, entry: ShardEntry) -> Generator[None, None, dict[str, Any]]:
    """Render one shard into its folder, unless it is finished; a task in three parts.

    Returns ``record`` (the sidecar) and ``rendered`` (whether this call rendered it).

    Raises
    ------
    LockedError : another process writes it
    PartialError : the disk is full, or the store cannot be reached
    """
    if (record := run.finished(entry)) is not None:
        return {"record": record, "rendered": False}
    lock = take_lock(run.folder.workspace / entry.file)
    if lock is None:
        raise LockedError("is being written by another process", where=run.folder.at(entry.file))
    try:
        # Another process may have finished it since.
        if (record := run.finished(entry)) is not None:
            return {"record": record, "rendered": False}
        queries, weight = run.draw(entry)
        yield
        began, config = time.perf_counter(), run.job.config
        run.estimator.observe = run.observe
        # The values depend on seed, split and index, not on the process.
        estimates = estimate_shard(
            run.estimator,
            queries.flat(),
            split_spp(config, entry.split),
            split_target(config, entry.split),
            Stream(config.seed, entry.split, entry.index),
            # The allocation has the requested mean over the distribution of queries without weights.
            run.plan.allocation if weight is None else None,
            split_lights(config, entry.split),
        )
        seconds = time.perf_counter() - began
        yield
        return {"record": run.store(entry, queries, estimates, seconds, weight), "rendered": True}
    finally:
        lock.release()


def render_shards(
    run: ShardRun,
    entries: Sequence[ShardEntry],
    runner: Runner,
    *,
    progress: ProgressCallback | None = None,
) -> int:
    """Render those of the shards that are not finished; returns the number of paths traced. Errors are those
    of :func:`generate`; finished shards are kept."""
    start, job, folder = time.perf_counter(), run.job, run.folder
    totals, limit = ShardStatistics(), most_paths(job)
    # Leftovers of killed runs take disk space.
    folder.remove_leftovers()
    upload_waiting(folder, job.shards, job.config_hash, run.digest)
    items = [Item(entry.file, {"run": run, "entry": entry}) for entry in entries]
    expected = None if job.config.queries.target_error is not None else planned_paths(job, entries)
    busy, failed, row, left = list[str](), list[Result](), 0, len(items)
    traced = launched = 0

    def show() -> None:
        """Report the paths so far, their rate, and the noise of the training values."""
        if progress is None:
            return
        paths = max(traced, launched)
        rate = rate_text(paths / max(time.perf_counter() - start, 1e-9))
        where = "" if runner.here else f" on {runner.workers} workers"
        noise = totals.relative_error() if totals.train else None
        total = None if expected is None else max(expected, paths)
        progress(paths, f"{rate}{where}{'' if noise is None else f', noise {noise:.2%}'}", total)

    def observe(paths: int) -> None:
        nonlocal launched
        launched += paths
        show()

    if items and progress is not None:
        progress(0.0, "building the scene, compiling kernels, first paths", None)
    run.observe = observe
    with closing(runner.map(render_shard, items)) as results:
        for done in results:
            if done.locked:
                busy.append(done.name)
            elif done.error:
                failed.append(done)
                row += 1
                if row >= (1 if runner.here else max(_FAILURES, 2 * runner.workers)):
                    break
            else:
                row, left = 0, left - 1
                totals.add(done.value["record"])
                totals.refuse_nonfinite(limit, folder)
                traced += done.value["record"]["paths"] if done.value["rendered"] else 0
            show()
    _refuse_failed(failed, left, runner, folder)
    if busy:
        owner = lock_owner(folder.workspace / busy[0])
        who = "" if owner is None else f" ({owner})"
        raise PartialError(
            f"{len(busy)} shard(s) are being written by another process, first {busy[0]}{who}",
            where=folder,
            hint="wait for it, then run the same command again",
        )
    return traced


def _refuse_failed(failed: Sequence[Result], left: int, runner: Runner, folder: DataFolder) -> None:
    """Fail if shards have failed, with the reason of the first."""
    if failed and runner.here:
        raise PartialError(failed[0].error, hint=failed[0].hint)
    if failed:
        first = failed[0]
        raise PartialError(
            f"{len(failed)} shard(s) failed, {left} are left; first {first.name}: {first.error} "
            f"(on {first.worker})",
            where=folder,
            hint=first.hint or "the same command resumes",
        )
