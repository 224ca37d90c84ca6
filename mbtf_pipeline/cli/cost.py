"""``mbtf-pipeline cost``: accuracy against time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Output, Set, command_line
from mbtf_core.errors import UsageError


def cost(
    recipe: Path,
    /,
    *,
    output: Annotated[Output | None, Parameter(show_default="out/NAME-cost")] = None,
    time: Annotated[str, Parameter(metavar="DURATION")] = "10min",
    assignments: Set = None,
    console: Console = CONSOLE,
) -> None:
    """Measure error against time for this material and machine.

    Writes cost.html, cost.csv and PNGs: the errors of complete runs, and of the generator's options. The same
    command resumes. A longer time keeps all measurements and adds longer runs.

    Parameters
    ----------
    recipe
        YAML file; its material and generator are studied.
    time
        Time budget: 90s, 2min, 1h.
    """
    from mbtf_core.files.folders import owned
    from mbtf_core.run.signals import keep_on_interruption
    from mbtf_core.units import asked_duration, clock
    from mbtf_fit.config import DEFAULT_MODEL
    from mbtf_pipeline.collection.recipes import load
    from mbtf_pipeline.cost.measurement import pareto_front
    from mbtf_pipeline.cost.page import write_page
    from mbtf_pipeline.cost.study import run_study
    from mbtf_pipeline.recipe import Recipe

    loaded = load(recipe, assignments or [])
    if not isinstance(loaded, Recipe):
        raise UsageError("has several materials", where=recipe, hint="study the recipe of one of them")
    if len(loaded.fit) > 1:
        console.note(f"only {DEFAULT_MODEL} is studied, with networks that suit the times; no other fit")
    seconds = asked_duration(time, "--time")
    folder = output if output is not None else loaded.folder.with_name(f"{loaded.folder.name}-cost")
    keep_on_interruption(f"the measurements are kept in {folder}")
    with console.progress(total=100, label="cost", unit="%") as bar:
        study = run_study(
            loaded,
            folder,
            seconds=seconds,
            command=command_line(
                *("mbtf-pipeline", "cost", recipe),
                time=time,
                output=output,
                set=assignments,
            ),
            announce=console.note,
            progress=lambda share, note: bar.update(round(100 * share, 1), note),
        )
    with owned(folder):
        page = write_page(study)
    front = pareto_front(study.measurements)
    data = {
        "page": page,
        "measurements": len(study.measurements),
        "skipped": study.skipped,
        "failed": study.failed,
        "seconds": study.description["taken"],
        "front": [
            {"seconds": m.seconds.value, "unexplained": m.error.as_dict(), "command": m.command}
            for m in front
        ],
    }
    runs = len(study.runs)
    counts = f"measured: {runs} of complete runs, {len(study.measurements) - runs} of the generator"
    taken = f"planned for {clock(seconds)}, took {clock(study.description['taken'])}"
    lines = [f"{page}: {taken}", f"configurations {counts}"]
    if study.skipped:
        lines[-1] += f"; not measured for lack of time: {len(study.skipped)}"
    lines += [f"failed: {text}" for text in study.failed]
    lines += [study.more] if study.more else []
    lines += [f"{clock(m.seconds.value)}: unexplained variance {m.error}: {m.command}" for m in front]
    console.report(data, "\n".join(lines))
