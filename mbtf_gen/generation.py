"""Generates a data set from a configuration: a folder of shards. Resumes an unfinished one."""

from __future__ import annotations

import time
from pathlib import Path

from mbtf_core.errors import PartialError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.dataset.folder import has_dataset, open_folder
from mbtf_gen.dataset.render_shards import ProgressCallback, render_shards
from mbtf_gen.dataset.sidecar import finished_record
from mbtf_gen.dataset.summary import Summary, finish, read_run_plan
from mbtf_gen.job import Job, planned_paths
from mbtf_gen.planning.run_plan import plan_run


def paths_left(job: Job, folder: str | Path, slice_index: int = 1, slice_count: int = 1) -> int:
    """Paths that :func:`generate` has yet to trace: those of the slice's unfinished shards."""
    entries = job.shards[slice_index - 1 :: slice_count]
    left = [e for e in entries if not finished_record(Path(folder), e, job.config_hash)]
    return planned_paths(job, left)


def generate(
    source: GeneratorConfig | Job,
    folder: str | Path,
    *,
    overwrite: bool = False,
    slice_index: int = 1,
    slice_count: int = 1,
    progress: ProgressCallback | None = None,
) -> Summary:
    """Generate a data set, or finish an unfinished one.

    All shards follow the plan in the folder's manifest, whichever machine renders them.

    Parameters
    ----------
    source : GeneratorConfig or Job
        The configuration, or the job of one whose material is loaded already.
    folder : str or Path
        Output folder. An unfinished data set of the same configuration is resumed.
    overwrite : bool
        Replace the folder's data set. With several slices, a data set of the same configuration is kept,
        because another slice may have begun it.
    slice_index, slice_count : int
        Generate every `slice_count`-th shard only, starting with number `slice_index`, from 1.
    progress : callable, optional
        Called after every shard with the number of planned paths that are done in this run (see
        :func:`paths_left`) and a note.

    Returns
    -------
    Summary
        Of the data set as it is now.

    Raises
    ------
    InputError
        Material or folder cannot be used.
    PartialError
        Other processes render some of the shards, the disk is full, or too many samples are non-finite.
        The same command resumes.
    """
    folder = Path(folder)
    start = time.perf_counter()
    job = source if isinstance(source, Job) else Job.prepare(source)
    overwrite = overwrite and not (slice_count > 1 and has_dataset(folder, job.config_hash))
    open_folder(job, folder, plan_run, overwrite)
    entries = job.shards[slice_index - 1 :: slice_count]
    result = render_shards(job, folder, entries, read_run_plan(folder), progress=progress)
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
