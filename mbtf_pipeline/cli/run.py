"""``mbtf-pipeline run``: a recipe."""

from __future__ import annotations

import time as clocks
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import (
    ClusterOption,
    Output,
    Quality,
    QualityOption,
    Set,
    Switch,
    Time,
    command_line,
)
from mbtf_core.errors import PartialError, UsageError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import clock
from mbtf_fit.cli.live import Live, live_view

if TYPE_CHECKING:
    from mbtf_pipeline.run import RunResult


def run(
    recipe: Path,
    /,
    *,
    output: Annotated[Output | None, Parameter(show_default="out/NAME")] = None,
    quality: QualityOption = None,
    time: Time = None,
    quick: Switch = False,
    force: Switch = False,
    live: Live = False,
    cluster: ClusterOption = None,
    assignments: Set = None,
    console: Console = CONSOLE,
) -> None:
    """Run a recipe: mbtf-pipeline run pipelines/quickstart.yaml

    A stage whose inputs have not changed is skipped; the same command again resumes an interrupted run.
    --time is the time of everything: it takes the best preset of --quality that fits, with more queries and
    longer training, and replaces the recipe's own.

    Parameters
    ----------
    recipe
        YAML file.
    quick
        Use the small sizes of a paper recipe: minutes in place of hours.
    force
        Run every stage, also those that are up to date.
    """
    # Python itself has run for about a second.
    began = clocks.perf_counter() - 1.0
    from mbtf_pipeline.library.entries import is_library_recipe
    from mbtf_pipeline.papers.plan import is_paper_recipe

    given = {"quality": quality, "time": time, "quick": quick, "output": output, "set": assignments}
    command = command_line("mbtf-pipeline", "run", recipe, **given)
    own = assignments or []
    if is_paper_recipe(recipe):
        for flag, used in (("--live", live), ("--cluster", cluster is not None)):
            if used:
                raise UsageError("is for a single run", where=flag, hint="leave it out for a paper recipe")
        if quality is not None or time is not None:
            raise UsageError(
                "a paper recipe has sizes and times of its own",
                where="--time" if quality is None else "--quality",
                hint="leave it out; --quick is the small size",
            )
        return _run_paper(recipe, output, quick, force, own, command, console)
    if is_library_recipe(recipe):
        refused = {"--quality": quality, "--time": time, "--quick": quick, "--force": force, "--live": live}
        if wrong := [flag for flag, used in refused.items() if used]:
            hint = "set 'base' and 'training' in the recipe"
            raise UsageError("is not for a library of materials", where=wrong[0], hint=hint)
        return _run_library(recipe, output, own, cluster, command, console)
    if quick:
        raise UsageError("only paper recipes have quick sizes", where="--quick", hint="use --quality draft")
    from mbtf_core.run.cluster import open_runner
    from mbtf_pipeline.run import run_recipe

    if time is not None:
        from mbtf_core.units import asked_duration
        from mbtf_pipeline.time_split import TimedRun

        seconds = asked_duration(time, "--time")
        timed = TimedRun(
            recipe, seconds, output, command, console.note, quality=quality, assignments=own, began=began
        )
        keep_on_interruption(f"the finished stages are kept in {timed.folder}")
        with (
            open_runner(cluster, console.note) as runner,
            live_view(timed.recipe.title, live, console) as shown,
        ):
            result = run_recipe(
                timed.recipe,
                timed.folder,
                force=force,
                command=command,
                console=console,
                generated=timed.generated,
                live=shown,
                runner=runner,
            )
        return _report(result, console, timed.split.quality)
    from mbtf_pipeline.forecast import forecast_left
    from mbtf_pipeline.presets import preset_recipe

    loaded = preset_recipe(recipe, quality, own)
    keep_on_interruption(f"the finished stages are kept in {output or loaded.folder}")
    expected = forecast_left(loaded, output or loaded.folder)
    if expected is not None:
        console.note(expected.describe())
    with (
        open_runner(cluster, console.note) as runner,
        live_view(loaded.title, live, console) as shown,
    ):
        result = run_recipe(
            loaded, output, force=force, command=command, console=console, live=shown, runner=runner
        )
    _report(result, console, quality)


def _run_paper(
    file: Path,
    output: Path | None,
    quick: bool,
    force: bool,
    assignments: list[str],
    command: str,
    console: Console,
) -> None:
    from mbtf_pipeline.papers.plan import load_paper_recipe, plan
    from mbtf_pipeline.papers.suite import run_paper

    paper = load_paper_recipe(file, assignments)
    planned, missing = plan(paper, file, quick)
    folder = output if output is not None else paper.folder(quick)
    keep_on_interruption(f"the finished stages are kept in {folder}")
    done = run_paper(
        paper, planned, missing, folder, quick=quick, command=command, force=force, console=console
    )
    skipped = f", {len(missing)} skipped: {', '.join(missing)}" if missing else ""
    size = done.record["size"]
    data = {"folder": done.folder, "page": done.page, "size": size, "tables": done.tables}
    data |= {"runs": [one.name for one in planned], "skipped": missing}
    console.report(data, f"{done.page}: {size} size, {len(planned)} runs{skipped}")


def _run_library(
    file: Path,
    output: Path | None,
    assignments: list[str],
    cluster: str | None,
    command: str,
    console: Console,
) -> None:
    from mbtf_core.run.cluster import open_runner
    from mbtf_core.run.processes import Processes
    from mbtf_pipeline.library.entries import entries, load_library_recipe
    from mbtf_pipeline.library.run import run_library

    library = load_library_recipe(file, assignments)
    found = entries(library, file)
    folder = output if output is not None else library.folder
    keep_on_interruption(f"the finished stages are kept in {folder}")
    with open_runner(cluster, console.note, Processes()) as runner:
        done = run_library(library, found, folder, command=command, console=console, runner=runner)
    count = len(found) - len(done.failed)
    data = {"folder": done.folder, "page": done.page, "materials": done.record["materials"]}
    console.report(data, f"{done.page}: {count} of {len(found)} materials")
    for name, error in done.failed.items():
        console.note(f"{name}: {error}")
    if done.failed:
        raise PartialError(
            f"{len(done.failed)} of {len(found)} materials failed",
            where=folder,
            hint="the same command tries them again and keeps the others",
        )
    if done.shared_error:
        hint = "the same command tries it again"
        raise PartialError(f"no shared network: {done.shared_error}", where=folder, hint=hint)


def _report(result: RunResult, console: Console, quality: Quality | None) -> None:
    from mbtf_pipeline.number_text import estimate

    tests = {fit: record["splits"]["test"] for fit, record in result.comparison["test"].items()}
    ran = {name: stage.stamp.seconds for name, stage in result.stages.items() if stage.ran}
    data = {
        "folder": result.folder,
        "report": result.report,
        "viewer": result.viewer,
        "quality": quality,
        "seconds": round(sum(ran.values()), 3),
        "stages": {
            name: {"ran": o.ran, "reason": o.reason or "up to date", "seconds": o.stamp.seconds}
            for name, o in result.stages.items()
        },
        "test": {
            fit: {"unexplained_variance": e["unexplained"], "mse": e["mse"]} for fit, e in tests.items()
        },
    }
    times = ", ".join(f"{name} {clock(seconds)}" for name, seconds in ran.items())
    lines = [f"{result.report}: {times or 'everything up to date'}"]
    lines += [f"  {fit}: unexplained variance {estimate(e['unexplained'])}" for fit, e in tests.items()]
    if result.viewer is not None:
        lines.append(f"{result.viewer}: open it in a browser to turn the fits under lights")
    console.report(data, "\n".join(lines))
