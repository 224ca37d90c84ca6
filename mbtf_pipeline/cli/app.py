"""Command line of ``mbtf-pipeline``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console, clock, new_app
from mbtf_core.errors import InputError, MbtfError, UsageError
from mbtf_gen.config.presets import Quality

if TYPE_CHECKING:
    from mbtf_pipeline.recipe import Recipe
    from mbtf_pipeline.run import RunResult

app = new_app("mbtf-pipeline", "Run recipes: generate, fit, compare, report.")

Set = Annotated[list[str], Parameter(name="--set", help="Set any option of the recipe, a.b=c. Repeatable.")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]
QualityOption = Annotated[Quality, Parameter(help="Sizes and times of all stages, in place of the recipe's.")]
_FOLDER = Path("pipelines")


@app.command
def run(
    recipe: Path,
    /,
    *,
    output: Output = None,
    quality: QualityOption | None = None,
    budget: str | None = None,
    quick: Annotated[bool, Parameter(negative="")] = False,
    force: Annotated[bool, Parameter(negative="")] = False,
    assignments: Set | None = None,
    console: Console = CONSOLE,
) -> None:
    """Run a recipe: mbtf-pipeline run pipelines/quickstart.yaml

    A stage whose inputs have not changed is skipped; the same command again resumes an interrupted run.

    Parameters
    ----------
    recipe
        YAML file.
    output
        Folder of the run. Default: out/NAME
    budget
        Time for generating and training together: 90s, 10min, 1h. Pilots on this machine split it; it takes
        the place of the recipe's queries and training times. Comparison and report come on top.
    quick
        The quick size of a paper recipe: minutes in place of hours.
    force
        Run every stage, also those that are up to date.
    """
    from mbtf_pipeline.paper_tables.recipe import is_paper_recipe

    if is_paper_recipe(recipe):
        if quality is not None:
            hint = "leave it out; --quick is the small size"
            raise UsageError("a paper recipe has sizes of its own", where="--quality", hint=hint)
        if budget is not None:
            hint = "leave it out; --quick is the small size"
            raise UsageError("a paper recipe has times of its own", where="--budget", hint=hint)
        _run_paper(recipe, output, quick, force, assignments or [], console)
        return
    if quick:
        raise UsageError("only paper recipes have a quick size", where="--quick", hint="use --quality draft")
    from mbtf_pipeline.presets import quality_assignments
    from mbtf_pipeline.recipe import load_recipe
    from mbtf_pipeline.run import run_recipe

    loaded = load_recipe(
        recipe, [*quality_assignments(recipe, quality, assignments or []), *(assignments or [])]
    )
    command = ["mbtf-pipeline", "run", str(recipe)]
    command += ["--quality", quality] if quality is not None else []
    command += ["--budget", budget] if budget is not None else []
    command += ["-o", str(output)] if output is not None else []
    command += [part for a in assignments or [] for part in ("--set", a)]
    if budget is not None:
        loaded = _budgeted(loaded, budget, output, shlex.join(command), console)
    result = run_recipe(loaded, output, force=force, command=shlex.join(command), console=console)
    console.report(_summary(result), _describe(result))


def _budgeted(loaded: Recipe, budget: str, output: Path | None, command: str, console: Console) -> Recipe:
    from mbtf_core.units import asked_duration
    from mbtf_pipeline.cost_study.time_split import split_budget, within_budget

    seconds = asked_duration(budget, "--budget")
    split = split_budget(loaded, seconds, output or loaded.folder, command, console.note)
    console.note(split.describe())
    return within_budget(loaded, split)


def _run_paper(
    file: Path, output: Path | None, quick: bool, force: bool, assignments: list[str], console: Console
) -> None:
    from mbtf_pipeline.paper_tables.recipe import load_paper_recipe, plan
    from mbtf_pipeline.paper_tables.suite import run_paper

    paper = load_paper_recipe(file, assignments)
    planned, missing = plan(paper, file, quick)
    folder = output if output is not None else paper.folder(quick)
    command = ["mbtf-pipeline", "run", str(file), *(["--quick"] if quick else [])]
    command += ["-o", str(output)] if output is not None else []
    command += [part for a in assignments for part in ("--set", a)]
    done = run_paper(
        paper,
        planned,
        missing,
        folder,
        quick=quick,
        command=shlex.join(command),
        force=force,
        console=console,
    )
    skipped = f", {len(missing)} skipped: {', '.join(missing)}" if missing else ""
    data = {
        "folder": done.folder,
        "page": done.page,
        "size": done.record["size"],
        "tables": done.tables,
        "runs": [one.name for one in planned],
        "skipped": missing,
    }
    size = done.record["size"]
    console.report(data, f"{done.page}: {size} size, {len(planned)} runs{skipped}")


def _summary(result: RunResult) -> dict[str, Any]:
    return {
        "folder": result.folder,
        "report": result.report,
        "seconds": round(sum(o.stamp.seconds for o in result.outcomes.values() if o.ran), 3),
        "stages": {
            name: {"ran": o.ran, "reason": o.reason or "up to date", "seconds": o.stamp.seconds}
            for name, o in result.outcomes.items()
        },
        "test": {
            fit: {
                "unexplained_variance": r["splits"]["test"]["unexplained"],
                "mse": r["splits"]["test"]["mse"],
            }
            for fit, r in result.comparison["test"].items()
        },
    }


def _describe(result: RunResult) -> str:
    from mbtf_pipeline.formatting import estimate

    ran = [f"{n} {clock(o.stamp.seconds)}" for n, o in result.outcomes.items() if o.ran]
    lines = [f"{result.report}: {', '.join(ran) or 'everything up to date'}"]
    for fit, record in result.comparison["test"].items():
        lines.append(f"  {fit}: unexplained variance {estimate(record['splits']['test']['unexplained'])}")
    return "\n".join(lines)


@app.command(name="list")
def list_recipes(
    folder: Path = _FOLDER,
    /,
    *,
    verbose: Annotated[bool, Parameter(alias="-v", negative="")] = False,
    console: Console = CONSOLE,
) -> None:
    """List the recipes of a folder.

    Parameters
    ----------
    folder
        Where to look.
    verbose
        Also say which stages of each would run (reads what they made).
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=folder)
    found = [_entry(path, verbose) for path in sorted(folder.glob("*.y*ml"))]
    lines = []
    for entry in found:
        lines.append(f"{entry['file']}: {entry['error'] or entry['description'] or entry['name']}")
        lines += [f"    {stage}: {state}" for stage, state in entry["stages"].items()]
    console.report({"recipes": found}, "\n".join(lines) or f"{folder}: no recipes")


def _entry(path: Path, verbose: bool) -> dict[str, Any]:
    from mbtf_pipeline.paper_tables.recipe import is_paper_recipe, load_paper_recipe
    from mbtf_pipeline.recipe import load_recipe

    entry: dict[str, Any] = {
        "file": str(path),
        "name": None,
        "description": None,
        "error": None,
        "stages": {},
    }
    try:
        if is_paper_recipe(path):
            paper = load_paper_recipe(path, [])
            about = {"name": paper.name, "description": paper.description}
            return entry | about | {"folder": str(paper.folder(False))}
        recipe = load_recipe(path)
        entry |= {"name": recipe.name, "description": recipe.description, "folder": str(recipe.folder)}
        if verbose:
            from mbtf_pipeline.run import survey

            decisions = survey(recipe, recipe.folder)
            entry["stages"] = {name: d.reason or "up to date" for name, d in decisions.items()}
    except MbtfError as error:
        entry["error"] = _without(path, error.message.splitlines()[0])
    return entry


def _without(path: Path, message: str) -> str:
    """A message about a recipe without the recipe's path, which stands before it already."""
    rest = message.removeprefix(f"{path}:")
    return message if rest == message else f"line {rest}" if rest[:1].isdigit() else rest.strip()


@app.command
def report(folder: Path, /, *, console: Console = CONSOLE) -> None:
    """Write the report of a finished run again, or the page and tables of a paper recipe.

    Parameters
    ----------
    folder
        Folder of the run.
    """
    from mbtf_pipeline.paper_tables.suite import is_paper, write_again
    from mbtf_pipeline.run import rerender

    path = write_again(folder) if is_paper(folder) else rerender(folder)
    size = path.stat().st_size
    console.report({"report": path, "bytes": size}, f"{path}: {size / 1e6:.1f} MB")


@app.command
def cost(
    recipe: Path,
    /,
    *,
    output: Output = None,
    time: str | None = None,
    narrow: str | None = None,
    seed: int | None = None,
    assignments: Set | None = None,
    console: Console = CONSOLE,
) -> None:
    """Measure what accuracy costs in time, on this material and machine: mbtf-pipeline cost RECIPE

    Writes cost.html, cost.csv and PNGs. The same command again goes on where it stopped. A longer time keeps
    the generator's settings that were measured, adds others, and makes longer chains.

    Parameters
    ----------
    recipe
        YAML file; its material and generator are studied.
    output
        Folder of the study. Default: out/NAME-cost
    time
        Budget: 90s, 10min, 1h. Default: that of the study in the folder, 10min for a new one
    narrow
        Afterwards so much more: chains whose errors are known to worse than ± 10 % (95 %) again with other
        seeds.
    seed
        Of queries, paths and first weights. Default: the recipe's
    """
    from mbtf_core.units import asked_duration, format_duration
    from mbtf_pipeline.cost_study.page import whole_chains, write_page
    from mbtf_pipeline.cost_study.study import budget_of, run_study
    from mbtf_pipeline.recipe import load_recipe

    more = 0.0 if narrow is None else asked_duration(narrow, "--narrow")
    loaded = load_recipe(recipe, assignments or [])
    folder = output if output is not None else loaded.folder.with_name(f"{loaded.folder.name}-cost")
    budget = budget_of(folder) if time is None else asked_duration(time, "--time")
    command = ["mbtf-pipeline", "cost", str(recipe), "--time", time or format_duration(budget)]
    command += ["--narrow", narrow] if narrow is not None else []
    command += ["-o", str(output)] if output is not None else []
    command += ["--seed", str(seed)] if seed is not None else []
    command += [part for a in assignments or [] for part in ("--set", a)]
    with console.progress(total=100, label="cost", unit="%") as bar:
        study = run_study(
            loaded,
            folder,
            budget=budget,
            narrow=more,
            seed=seed,
            command=shlex.join(command),
            tell=lambda share, note: bar.update(round(100 * share, 1), note),
        )
    page = write_page(study)
    from mbtf_pipeline.cost_study.pareto import pareto_front

    front = pareto_front(whole_chains(study.points))
    lines = [f"{page}: {len(study.points)} settings measured, {len(study.skipped)} not for lack of time"]
    lines += [f"could not be measured: {text}" for text in study.failed]
    lines += [f"  {p.seconds.value:.0f} s: unexplained variance {p.error}   {p.command}" for p in front]
    data = {
        "page": page,
        "points": len(study.points),
        "skipped": study.skipped,
        "failed": study.failed,
        "front": [
            {"seconds": p.seconds.value, "unexplained": p.error.as_dict(), "command": p.command}
            for p in front
        ],
    }
    console.report(data, "\n".join(lines))
