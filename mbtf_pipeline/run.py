"""Runs a recipe: its stages in the folder of the run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from mbtf_core.app.console import Console
from mbtf_core.config.settings import build
from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.files.atomic import file_sha256, read_json
from mbtf_core.files.folders import check_space, owned
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_core.units import clock
from mbtf_fit.config import FitConfig
from mbtf_fit.models import code_of
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.compare.compare import COMPARISON_NAME, COMPARISON_SCHEMA
from mbtf_pipeline.recipe import Recipe, read_resolved
from mbtf_pipeline.report.report import LAYOUT
from mbtf_pipeline.stages import (
    COMPARE,
    FITS,
    FORCED,
    NOT_RUN,
    REPORT,
    RUN,
    SHARDS,
    VIEWER,
    Decision,
    Stage,
    StageResult,
    clear,
    decide,
    read_stamp,
    run_stages,
    write_run_record,
)

if TYPE_CHECKING:
    from mbtf_core.data.schema import Layout

GENERATE_STAGE, COMPARE_STAGE, REPORT_STAGE = "generate", "compare", "report"


def fit_stage(name: str) -> str:
    """Name of a fit's stage."""
    return f"fit {name}"


class DataSet(NamedTuple):
    """A data set of a run: name of its stage, its folder within the run's, options of the generator."""

    stage: str
    sub: str
    config: GeneratorConfig


def layout_of(config: FitConfig, own: Layout) -> Layout:
    """Layout of the data that a fit is trained on: the recipe's `own`, if its model reads it."""
    from mbtf_fit.models.registry import model_class

    model = model_class(config.model)
    return own if model.reads(own) else model.layout


def data_sets(recipe: Recipe) -> list[DataSet]:
    """The recipe's data set, and one of the other layout if a model requires it.

    The second one has as many training queries. All fits are evaluated on the test split of the first.
    """
    out = [DataSet(GENERATE_STAGE, SHARDS, recipe.generate)]
    own = recipe.generate.queries.layout
    for layout in sorted({layout_of(config, own) for config in recipe.fit.values()} - {own}):
        queries = recipe.generate.queries.model_copy(update={"layout": layout, "test": "1"})
        config = recipe.generate.model_copy(update={"queries": queries})
        out.append(DataSet(f"{GENERATE_STAGE} {layout}", f"{SHARDS}-{layout}", config))
    return out


def slices_folder(recipe: Recipe) -> str:
    """Sub-folder of the recipe's data set of slices."""
    return next(data.sub for data in data_sets(recipe) if data.config.queries.layout == "slices")


@dataclass(frozen=True)
class RunResult:
    """Result of a run.

    Attributes
    ----------
    report : Path
        HTML file.
    viewer : Path or None
        HTML file that shows the fits; None where no fit can be shown in a browser.
    stages : dict of str to StageResult
        Results by name of the stage, in order.
    comparison : dict
        Content of ``compare/comparison.json``.
    """

    report: Path
    viewer: Path | None
    stages: dict[str, StageResult]
    comparison: dict[str, Any]


@dataclass(frozen=True)
class _RecipeRun:
    """The stages of one recipe in one folder."""

    recipe: Recipe
    folder: Path
    console: Console
    runner: Runner = field(default_factory=Runner)

    def stages(self, inputs: Mapping[str, str]) -> list[Stage]:
        """All stages; `inputs` holds the digests of the material's files by role."""
        recipe = self.recipe
        data_of: dict[str, DataSet] = {d.config.queries.layout: d for d in data_sets(recipe)}
        out = []
        for data in data_of.values():
            config = data.config.model_dump(mode="json", exclude={"material"})
            out.append(Stage(data.stage, (), config, inputs, (data.sub,), partial(self._generate, data)))
        for name, fit in recipe.fit.items():
            data, fields = data_of[layout_of(fit, recipe.generate.queries.layout)], fit.fields()
            # Data sets of other materials count by what they hold, not by where they lie.
            others = [_manifest_digest(Path(folder)) for folder in fit.training.materials]
            fields["training"] = {**fields["training"], "materials": others}
            run, remote = partial(self._fit, name, data), not self.runner.here
            code = code_of(fit.model)
            out.append(Stage(fit_stage(name), (data.stage,), fields, code, (f"{FITS}/{name}",), run, remote))
        needs = (GENERATE_STAGE, *map(fit_stage, recipe.fit))
        compared = {"record": COMPARISON_SCHEMA, **recipe.compare.model_dump(mode="json")}
        out.append(Stage(COMPARE_STAGE, needs, compared, {}, (COMPARE,), self._compare))
        return [*out, self.report_stage()]

    def report_stage(self) -> Stage:
        """The last stage, which needs no code of the fits' models."""
        recipe = self.recipe
        shown = {"name": recipe.name, "description": recipe.description, "layout": LAYOUT}
        shown |= recipe.report.model_dump(mode="json")
        needs = (GENERATE_STAGE, *map(fit_stage, recipe.fit), COMPARE_STAGE)
        return Stage(REPORT_STAGE, needs, shown, {}, (REPORT, VIEWER), self._report)

    def _generate(self, data: DataSet, decision: Decision) -> float:
        from mbtf_core.data.dataset import is_dataset
        from mbtf_core.data.documents import read_manifest
        from mbtf_core.data.folder import sidecar_name
        from mbtf_core.data.schema import MANIFEST_NAME
        from mbtf_gen.generation.run import generate, unfinished
        from mbtf_gen.planning.job import Job, data_bytes

        job = Job.load(data.config)
        if data.stage == GENERATE_STAGE:  # that of another layout is of the same material
            job.announce()
        shards = self.folder / data.sub
        for path in decision.changed_files:
            if path.name != MANIFEST_NAME:
                path.unlink(missing_ok=True)
                path.with_name(sidecar_name(path.name)).unlink(missing_ok=True)
        # A lost or damaged manifest is refused: the shards may be whole.
        if (
            decision.reason == FORCED
            or not is_dataset(shards)
            or read_manifest(shards)["config_hash"] != job.config_hash
        ):
            clear(shards)
        hint = "reduce generate.queries with --set or --quality, or choose another folder with -o"
        check_space(shards, data_bytes(job, unfinished(job, shards)), hint)
        with self.console.progress(None, data.stage, "paths") as bar:
            done = generate(job, shards, progress=bar.update, runner=self.runner)
        # Workers render at the same time; slices of earlier processes are the time that the data took.
        return done.shard_seconds if self.runner.here else 0.0

    def _fit(self, name: str, data: DataSet, decision: Decision) -> float:
        from mbtf_fit import fit
        from mbtf_fit.training.fit_many import fit_one

        config, shards, out = self.recipe.fit[name], self.folder / data.sub, self.folder / FITS / name
        if decision.reason != NOT_RUN or not _unfinished(out, config, shards):
            clear(out)
        if not self.runner.here:
            # The worker's checkpoints make the fit resumable; its curve is in its folder.
            arguments = {"config": config, "shards": shards, "folder": out, "overwrite": False}
            item = Item(name, arguments, gpu=self.runner.takes_gpu(config.device))
            (done,) = self.runner.map(fit_one, [item])
            if done.error:
                raise PartialError(done.error, where=fit_stage(name), hint="the same command resumes the run")
            return 0.0
        with self.console.progress(100, fit_stage(name), "%") as bar:
            done = fit(
                config,
                shards,
                out,
                progress=lambda phase, share, note: bar.update(
                    round(100 * share, 1), note, label=f"{fit_stage(name)} {phase}"
                ),
            )
        return done.seconds

    def _compare(self, decision: Decision) -> None:
        from mbtf_pipeline.compare.compare import compare, steps

        out, shards = self.folder / COMPARE, self.folder / SHARDS
        clear(out)
        recipe, fits = self.recipe, {name: self.folder / FITS / name for name in self.recipe.fit}
        with self.console.progress(steps(recipe.compare, len(fits)), "compare", "pictures") as bar:
            advance = partial(bar.advance, 1)
            compare(recipe.compare, recipe.generate, shards, fits, out, advance, self.runner)

    def show(self, stage: str, decision: Decision, seconds: float | None) -> None:
        """Say a stage's state."""
        if seconds is None:
            state = f"running ({decision.reason})" if decision.reason else "up to date"
        else:
            state = f"finished in {clock(seconds)}"
        if decision.reason or seconds is None:
            self.console.note(f"{stage}: {state}")

    def _report(self, decision: Decision) -> None:
        from mbtf_pipeline.report.report import write_report, write_viewer

        write_report(self.folder, self.recipe, [stage.name for stage in self.stages({})][:-1])
        write_viewer(self.folder, self.recipe.title, read_json(self.folder / COMPARE / COMPARISON_NAME))


def _manifest_digest(shards: Path) -> str:
    """SHA-256 of a data set's manifest; empty where there is none."""
    from mbtf_core.data.schema import MANIFEST_NAME

    path = shards / MANIFEST_NAME
    return file_sha256(path) if path.is_file() else ""


def _unfinished(out: Path, config: FitConfig, shards: Path) -> bool:
    """Whether a folder contains this fit from an interrupted run."""
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.training.fit_folder import FIT, identity_of

    try:
        record = FIT.read(out)
        return (
            record is not None and record["hash"] == identity_of(config, Dataset.open(shards))["config_hash"]
        )
    except InputError:
        return False


def _material_inputs(recipe: Recipe) -> dict[str, str]:
    from mbtf_gen.tile.loading import latest_material

    largest = recipe.generate.geometry.max_pixels
    return dict(latest_material(recipe.generate.material, max_pixels=largest).digests)


@contextmanager
def _claimed(recipe: Recipe, folder: Path, command: str, overwrite: bool = False) -> Iterator[None]:
    """Own the folder of a run in a block, with its records."""
    with owned(folder):
        RUN.check(folder)
        write_run_record(folder, recipe, command, overwrite=overwrite)
        yield


def generate_data(recipe: Recipe, folder: Path, *, command: str = "", console: Console | None = None) -> None:
    """Run the stages of a recipe that generate data, for fits that learn from the data of several runs.

    Parameters and exceptions are those of :func:`run_recipe`.
    """
    run = _RecipeRun(recipe, folder, console or Console(quiet=True))
    with _claimed(recipe, folder, command):
        stages = run.stages(_material_inputs(recipe))[: len(data_sets(recipe))]
        run_stages(folder, stages, notify=run.show)


def run_recipe(
    recipe: Recipe,
    folder: Path | None = None,
    *,
    force: bool = False,
    command: str = "",
    console: Console | None = None,
    runner: Runner | None = None,
) -> RunResult:
    """Run a recipe; stages whose inputs have not changed are skipped.

    Parameters
    ----------
    recipe : Recipe
        From :func:`~mbtf_pipeline.recipe.load_recipe`.
    folder : Path, optional
        Folder of the run; by default the recipe's own.
    force : bool
        Run every stage.
    command : str
        Command that the report shows for reproduction.
    console : Console, optional
        Receives progress; quiet by default.
    runner : Runner, optional
        Renders shards and reference pictures and trains the fits; in this process by default.

    Returns
    -------
    RunResult
        Paths, results of the stages, and the comparison.

    Raises
    ------
    InputError
        The material, a data set or the folder cannot be used.
    PartialError
        Another process uses the folder, or the disk is full; the same command resumes the run.
    """
    folder = recipe.folder if folder is None else folder
    run = _RecipeRun(recipe, folder, console or Console(quiet=True), runner or Runner())
    with _claimed(recipe, folder, command, force):
        results = run_stages(folder, run.stages(_material_inputs(recipe)), force=force, notify=run.show)
    viewer, comparison = folder / VIEWER, read_json(folder / COMPARE / COMPARISON_NAME)
    return RunResult(folder / REPORT, viewer if viewer.is_file() else None, results, comparison)


def survey(recipe: Recipe, folder: Path) -> dict[str, str]:
    """Why :func:`run_recipe` would run each stage, without running any; empty where it is up to date."""
    run = _RecipeRun(recipe, folder, Console(quiet=True))
    out: dict[str, str] = {}
    for stage in run.stages(_material_inputs(recipe)):
        out[stage.name] = decide(folder, stage, [name for name, reason in out.items() if reason]).reason
    return out


def rerender(folder: Path, exposure: float | Literal["auto"] | None = None) -> tuple[Path, float]:
    """Write the report of a finished run again, at an exposure in EV, by default the recipe's; returns the
    HTML file, and the exposure of its images. An InputError where the folder contains no run of this version,
    or its comparison is not finished; a UsageError where the exposure is out of range."""
    RUN.read(folder)
    recipe = read_resolved(folder)
    if exposure is not None:
        given, flags = {**recipe.report.model_dump(), "exposure": exposure}, {"exposure": "--exposure"}
        report = build(type(recipe.report), given, source="report", error=UsageError, spelled=flags)
        recipe = recipe.model_copy(update={"report": report})
    stage = _RecipeRun(recipe, folder, Console(quiet=True)).report_stage()
    with owned(folder):
        for name in stage.needs:
            if read_stamp(folder, name) is None:
                hint = "run the recipe again: it resumes"
                raise InputError(f"stage '{name}' is not finished", where=folder, hint=hint)
        run_stages(folder, [stage], force=True)
    comparison = read_json(folder / COMPARE / COMPARISON_NAME)
    used = recipe.report.exposure
    return folder / REPORT, float(comparison["exposure"]) if used == "auto" else used
