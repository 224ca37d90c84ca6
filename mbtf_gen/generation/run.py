"""Generates a data set from a configuration: a folder of shards. Resumes an unfinished one."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from mbtf_core.data.documents import finished_record
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import ShardEntry
from mbtf_core.errors import PartialError
from mbtf_core.run.runner import Runner
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import has_dataset, open_folder, read_run_plan
from mbtf_gen.generation.render_shards import ProgressCallback, render_shards
from mbtf_gen.generation.summary import Summary, finish
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import RunPlan, plan_run


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
    planned: Callable[[RunPlan], None] | None = None,
    progress: ProgressCallback | None = None,
    runner: Runner | None = None,
) -> Summary:
    """Generate a data set, or finish an unfinished one.

    All shards follow the plan in the folder's manifest, whichever machine renders them.

    Parameters
    ----------
    source : GeneratorConfig or Job
        The configuration, or the job of one whose material is loaded already.
    folder : str, Path or DataFolder
        Output folder, or a URL such as ``s3://bucket/data``. An unfinished data set of the same configuration
        is resumed.
    overwrite : bool
        Replace the folder's data set. With several slices, a data set of the same configuration is kept,
        because another slice may have begun it.
    slice_index, slice_count : int
        Generate every `slice_count`-th shard only, starting with number `slice_index`, from 1.
    planned : callable, optional
        Called with the run's plan. A new data set is not yet written then.
    progress : callable, optional
        Called after every shard with the paths of this run so far, a note, and the paths that the run is
        expected to trace (None where a target error leaves it open).
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
    PartialError
        Other processes render some of the shards, the disk is full, the store cannot be reached, or too many
        samples are non-finite. The same command resumes.
    """
    folder = DataFolder.open(folder)
    start = time.perf_counter()
    job = source if isinstance(source, Job) else Job.prepare(source)
    overwrite = overwrite and not (slice_count > 1 and has_dataset(folder, job.config_hash))
    plans: list[RunPlan] = []

    def new_plan(job: Job) -> RunPlan:
        plans.append(plan_run(job))
        if planned is not None:
            planned(plans[0])
        return plans[0]

    open_folder(job, folder, new_plan, overwrite)
    plan = read_run_plan(folder)
    entries = unfinished(job, folder, slice_index, slice_count)
    if planned is not None and not plans and entries:
        planned(plan)
    result = render_shards(job, folder, entries, plan, runner or Runner(), start=start, progress=progress)
    seconds = time.perf_counter() - start
    summary = finish(
        folder, paths=result.paths, seconds=seconds, writing=result.writing, waiting=result.waiting
    )
    if slice_count == 1 and not summary.complete:
        raise PartialError(
            "finished shards are missing or cannot be read",
            where=folder,
            hint="run the same command again",
        )
    return summary
