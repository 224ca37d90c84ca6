"""``mbtf-pipeline emit``: job files of a recipe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from mbtf_core.console import CONSOLE, Console
from mbtf_core.errors import UsageError
from mbtf_core.options import Output, Overwrite, Set, command_line
from mbtf_gen.config.presets import QualityOption

_AT_LEAST_ONE = Number(gte=1, lte=10_000)


def emit(
    recipe: Path,
    /,
    *,
    to: list[Literal["slurm", "k8s", "make"]] | None = None,
    output: Output = Path("jobs"),
    run_folder: Annotated[Path | None, Parameter(show_default="out/NAME")] = None,
    quality: QualityOption = None,
    slices: Annotated[int, Parameter(validator=_AT_LEAST_ONE)] = 8,
    cpus: Annotated[int, Parameter(validator=_AT_LEAST_ONE)] = 8,
    job_memory: Annotated[str, Parameter(metavar="SIZE")] = "8GB",
    time_limit: Annotated[str | None, Parameter(metavar="DURATION", show_default="from a forecast")] = None,
    gpus: Annotated[int, Parameter(validator=Number(gte=0, lte=64))] = 0,
    image: Annotated[str | None, Parameter(metavar="NAME")] = None,
    volume: Annotated[str | None, Parameter(metavar="CLAIM", show_default="mbtf")] = None,
    assignments: Set = None,
    overwrite: Overwrite = False,
    console: Console = CONSOLE,
) -> None:
    """Write the jobs of a recipe for a cluster: mbtf-pipeline emit pipelines/quickstart.yaml --to slurm

    An array of jobs generates the data, one job trains each fit, the last one compares and reports. All of
    them resume what an earlier job has begun. slurm: batch scripts, and submit.sh. k8s: Kubernetes jobs, and
    apply.sh; the volume holds a copy of the current folder. make: a makefile, for make -j.

    Parameters
    ----------
    recipe
        YAML file.
    to
        Format to write. Repeatable.
    run_folder
        Folder of the run.
    slices
        Number of jobs that share a data set.
    cpus
        Processor cores of each job.
    job_memory
        Memory of each job: 500MB, 4GB.
    time_limit
        Longest time of each job; jobs that reach it are restarted and resume.
    gpus
        GPUs of each fit.
    image
        Kubernetes: container image with the programs.
    volume
        Kubernetes: claim of the volume that all pods share.
    """
    if not to:
        raise UsageError("--to is missing", hint="choose --to slurm, --to k8s or --to make")
    given = {"--image": image, "--volume": volume}
    foreign = [flag for flag, value in given.items() if value is not None]
    if foreign and "k8s" not in to:
        raise UsageError("is an option of Kubernetes", where=foreign[0], hint="add --to k8s")
    if "k8s" in to and image is None:
        raise UsageError("is missing", where="--image", hint="name the container image with the programs")
    from mbtf_core.units import asked_duration, clock, parse_size
    from mbtf_pipeline.library.entries import is_library_recipe
    from mbtf_pipeline.papers.plan import is_paper_recipe

    if is_paper_recipe(recipe) or is_library_recipe(recipe):
        raise UsageError("has several runs", where=recipe, hint=f"use mbtf-pipeline run {recipe}")
    try:
        memory = parse_size(job_memory)
    except ValueError as error:
        raise UsageError(str(error), where="--job-memory") from None
    seconds = None if time_limit is None else asked_duration(time_limit, "--time-limit")
    from mbtf_pipeline.emit.jobs import emit_jobs
    from mbtf_pipeline.emit.kubernetes import Cluster
    from mbtf_pipeline.emit.steps import Request
    from mbtf_pipeline.presets import preset_recipe

    loaded = preset_recipe(recipe, quality, assignments or [])
    if seconds is None:
        console.note("forecasting the jobs on this machine; --time-limit skips it")
    done = emit_jobs(
        loaded,
        output,
        list(dict.fromkeys(to)),
        run=run_folder,
        slices=slices,
        request=Request(cpus, memory, seconds, gpus),
        cluster=None if image is None else Cluster(image, volume or Cluster.volume),
        command=command_line(
            "mbtf-pipeline", "run", recipe, quality=quality, output=run_folder, set=assignments
        ),
        overwrite=overwrite,
    )
    steps = [
        {
            "name": s.name,
            "needs": s.needs,
            "slices": s.slices or None,
            "command": s.words,
            "cpus": s.resources.cpus,
            "memory": s.resources.memory,
            "time_limit": s.resources.seconds,
            "gpus": s.resources.gpus,
        }
        for s in done.steps
    ]
    data = {"folder": done.folder, "run": done.run, "files": done.files, "start": done.start, "steps": steps}
    named = ", ".join(s.name + (f" ({s.slices} slices)" if s.slices else "") for s in done.steps)
    limits = sorted({s.resources.seconds for s in done.steps})
    time = " to ".join(clock(limit) for limit in dict.fromkeys((limits[0], limits[-1])))
    lines = [f"{done.folder}: {named}; {cpus} cores and {job_memory} each, at most {time}"]
    lines += [f"  {target}: {line}" for target, line in done.start.items()]
    console.report(data, "\n".join(lines))
