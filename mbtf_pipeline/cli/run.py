"""``mbtf-pipeline run``, ``report`` and ``list``: recipes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import (
    ClusterOption,
    DryRun,
    Output,
    Quality,
    QualityOption,
    Set,
    Switch,
    command_line,
)
from mbtf_core.errors import InputError, MbtfError, PartialError, UsageError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import clock
from mbtf_gen.config.pictures import EXPOSURE

if TYPE_CHECKING:
    from mbtf_pipeline.collection.run import CollectionResult
    from mbtf_pipeline.run import RunResult

UP_TO_DATE = "up to date"


def run(
    recipe: Path,
    /,
    *,
    output: Annotated[Output | None, Parameter(show_default="out/NAME")] = None,
    quality: QualityOption = None,
    quick: Switch = False,
    dry_run: DryRun = False,
    force: Switch = False,
    cluster: ClusterOption = None,
    assignments: Set = None,
    console: Console = CONSOLE,
) -> None:
    """Run a recipe.

    For example: mbtf-pipeline run pipelines/quickstart.yaml

    A stage whose inputs have not changed is skipped; the same command again resumes an interrupted run.
    --dry-run lists the stages that would run.

    Parameters
    ----------
    recipe
        YAML file.
    quick
        Use the small size of a recipe of several materials: minutes in place of hours.
    force
        Run every stage, also those that are up to date.
    """
    from mbtf_core.run.cluster import open_runner
    from mbtf_core.run.processes import Processes
    from mbtf_pipeline.collection.recipes import Collection, LibraryRecipe, load

    given = {"quality": quality, "quick": quick, "output": output, "set": assignments}
    command = command_line("mbtf-pipeline", "run", recipe, **given)
    loaded, own = load(recipe, assignments or []), assignments or []
    flags = given | {"dry_run": dry_run}
    if isinstance(loaded, Collection):
        from mbtf_pipeline.collection.run import run_collection

        hint = "set times in the recipe; --quick is its small size"
        _refuse(flags, ("quality", "dry_run"), "a recipe of several materials", hint)
        folder = output or loaded.folder_of(quick)
        keep_on_interruption(f"the finished stages are kept in {folder}")
        # A crash ends one material of a library alone; the runs of a paper show their progress.
        otherwise = Processes() if isinstance(loaded, LibraryRecipe) else None
        with open_runner(cluster, console.note, otherwise) as runner:
            done = run_collection(
                loaded,
                recipe,
                folder,
                command=command,
                runner=runner,
                quick=quick,
                force=force,
                console=console,
            )
        _report_collection(done, folder, console)
    else:
        _refuse(flags, ("quick",), "a recipe of one material", "use --quality draft")
        folder = output or loaded.folder
        from mbtf_pipeline.recipe import preset_recipe
        from mbtf_pipeline.run import run_recipe, survey
        from mbtf_pipeline.stages import RUN

        loaded = preset_recipe(recipe, quality, own)
        if dry_run:
            RUN.check(folder)
            found = survey(loaded, folder).items()
            stages = {name: "forced" if force else reason or UP_TO_DATE for name, reason in found}
            console.report({"stages": stages}, "\n".join(f"{name}: {why}" for name, why in stages.items()))
            return
        keep_on_interruption(f"the finished stages are kept in {folder}")
        with open_runner(cluster, console.note) as runner:
            result = run_recipe(
                loaded,
                folder,
                force=force,
                command=command,
                console=console,
                runner=runner,
            )
        _report(result, console, quality)


def _refuse(given: Mapping[str, Any], flags: Sequence[str], kind: str, hint: str) -> None:
    """Refuse flags that a kind of recipe does not have."""
    for flag in flags:
        if given[flag]:
            raise UsageError(
                f"is not for {kind}", where=f"--{flag.replace('_', '-')}", hint=f"leave it out: {hint}"
            )


def _report_collection(done: CollectionResult, folder: Path, console: Console) -> None:
    skipped, failed = done.names("skipped"), done.names("failed")
    count = len(done.runs) - len(skipped)
    text = f"{done.page}: {count - len(failed)} of {count} runs"
    text += f", {len(skipped)} skipped: {', '.join(skipped)}" if skipped else ""
    console.report({"folder": folder, "page": done.page, "tables": done.tables, "runs": done.runs}, text)
    if failed:
        raise PartialError(
            f"{len(failed)} of {count} runs failed: {', '.join(failed)}",
            where=folder,
            hint="the same command tries them again and keeps the others",
        )


def _report(result: RunResult, console: Console, quality: Quality | None) -> None:
    from mbtf_fit import Material
    from mbtf_fit.formatting import outliers, unreliable
    from mbtf_fit.training.endings import describe_ending
    from mbtf_fit.training.fit_folder import read_history
    from mbtf_fit.training.next_step import suggest
    from mbtf_fit.training.validation import caveat
    from mbtf_pipeline.recipe import read_resolved
    from mbtf_pipeline.stages import FITS
    from mbtf_pipeline.tables import estimate

    folder = result.report.parent
    ran = {name: stage.seconds for name, stage in result.stages.items() if stage.reason}
    times = ", ".join(f"{name} {clock(seconds)}" for name, seconds in ran.items())
    lines = [f"{result.report}: {times or 'everything up to date'}"]
    fits, recipe = {}, read_resolved(folder)
    for fit, record in result.comparison["test"].items():
        errors, history = record["splits"]["test"], read_history(folder / FITS / fit)
        ending = describe_ending(recipe.fit[fit], history)
        material = Material.load(folder / FITS / fit)
        step = suggest(material, history, record["splits"])
        why = caveat(history, material.description["training"], errors["unexplained"])
        fits[fit] = {
            "unexplained_variance": errors["unexplained"],
            "mse": errors["mse"],
            "ending": ending,
            "caveat": why or None,
            "advice": None if step is None else step.reason,
        }
        name = f"{fit} ({why})" if why else fit
        few = f" ({remark})" if (remark := unreliable(errors)) else ""
        lines.append(f"  {name}: unexplained variance {estimate(errors['unexplained'])}{few}")
        more = [*outliers(errors), ending, fits[fit]["advice"]]
        lines += [f"    {line}" for line in more if line]
    if result.viewer is not None:
        lines.append(f"{result.viewer}: open it in a browser to turn the fits under lights")
    data = {
        "folder": folder,
        "report": result.report,
        "viewer": result.viewer,
        "quality": quality,
        "seconds": round(sum(ran.values()), 3),
        "stages": {
            name: {"ran": name in ran, "reason": stage.reason or UP_TO_DATE, "seconds": stage.seconds}
            for name, stage in result.stages.items()
        },
        "test": fits,
    }
    console.report(data, "\n".join(lines))


def list_recipes(folder: Path = Path("pipelines"), /, *, console: Console = CONSOLE) -> None:
    """List the recipes of a folder.

    Parameters
    ----------
    folder
        Folder of recipes.
    """
    if not folder.is_dir():
        raise InputError("no such folder", where=folder)
    found = [_entry(path) for path in sorted(folder.glob("*.y*ml"))]
    # An error names its file.
    lines = [e["error"] or f"{e['file']}: {e['description'] or e['name']}" for e in found]
    console.report({"recipes": found}, "\n".join(lines) or f"{folder}: no recipes")


def _entry(path: Path) -> dict[str, Any]:
    from mbtf_pipeline.collection.recipes import load

    entry: dict[str, Any] = {"file": str(path), **dict.fromkeys(("name", "description", "error"))}
    try:
        recipe = load(path)
        entry |= {"name": recipe.name, "description": recipe.description, "folder": str(recipe.folder)}
    except MbtfError as error:
        entry["error"] = error.message.splitlines()[0]
    return entry


def report(
    folder: Path,
    /,
    *,
    exposure: Annotated[
        float | Literal["auto"] | None,
        Parameter(metavar="EV|auto", show_default=False, help=f"{EXPOSURE[0].upper()}{EXPOSURE[1:]}."),
    ] = None,
    console: Console = CONSOLE,
) -> None:
    """Write the report of a finished run again.

    The page of a paper recipe or of a library too.

    Parameters
    ----------
    folder
        Folder of the run.
    """
    from mbtf_core.color import describe_exposure
    from mbtf_pipeline.collection.run import COLLECTION, write_again
    from mbtf_pipeline.run import rerender

    used = None
    if COLLECTION.read(folder) is not None:
        if exposure is not None:
            raise UsageError("the page of several runs has no exposure", where="--exposure")
        path = write_again(folder)
    else:
        path, used = rerender(folder, exposure)
    size = path.stat().st_size
    text = f"{path}: {size / 1e6:.1f} MB" + ("" if used is None else f", {describe_exposure(used)}")
    console.report({"report": path, "bytes": size, "exposure": used}, text)
