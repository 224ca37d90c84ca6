"""``mbtf-fit SHARDS``: fit a material, or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import (
    MORE,
    ClusterOption,
    Options,
    Output,
    Overwrite,
    Quality,
    QualityOption,
    Switch,
    Verbose,
    options_from,
)
from mbtf_core.app.progress import Progress
from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_fit.cli.results import describe_fit, fits_table
from mbtf_fit.config import DEFAULT_MODEL, FitConfig, ModelName, best_model

if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder
    from mbtf_core.data.lattice import Lattice


@options_from(FitConfig)
class FitOptions(Options[FitConfig]):
    """Options of ``mbtf-fit``."""


def fit(
    shards: Path | None = None,
    /,
    *,
    output: Output = Path("material"),
    quality: QualityOption = None,
    options: FitOptions = FitOptions(),  # noqa: B008
    many: Annotated[list[Path] | None, Parameter(consume_multiple=True)] = None,
    shared_decoder: Annotated[Switch, Parameter(group=MORE)] = False,
    cluster: ClusterOption = None,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    console: Console = CONSOLE,
) -> None:
    """Fit a material to a data set: mbtf-fit shards/ -o material/

    The same command again resumes an unfinished fit. --time is that of training; the first line says about
    how long reading, calibration and errors take beside it. Errors, the validation error too, are those of
    test queries, which no fit is trained on. --quality trains 800 steps at least, even if they take longer,
    as does --time "12s, at least 800 steps". With --many, the output folder holds one folder per material.

    Parameters
    ----------
    shards
        Folder made by mbtf-gen, or its URL.
    many
        Fit several data sets, one material each: folders made by mbtf-gen, or folders of such folders. A fit
        that fails does not stop the others.
    shared_decoder
        With --many, fit all data sets together with one network. --time is that of all of them.
    """
    for refused, what, hint in (
        (many is not None and shards is not None, "--many replaces the argument SHARDS", "leave out one"),
        (many is None and shared_decoder, "--shared-decoder requires --many", "mbtf-fit --many a/ b/ ..."),
        (many is None and cluster is not None, "--cluster requires --many", "mbtf-fit --many a/ b/ ..."),
    ):
        if refused:
            raise UsageError(what, hint=hint)
    if many is not None:
        if shared_decoder:
            own = [*(options.assignments or ()), "training.shared_decoder=true"]
            options = replace(options, assignments=own)  # type: ignore[type-var]
        made = not output.exists()
        try:
            _fit_many(options, quality, many, output, cluster, overwrite, console)
        finally:
            # It is empty where every fit failed at once.
            with suppress(OSError):
                if made:
                    output.rmdir()
        return
    if shards is None:
        raise UsageError("no shards given", hint="mbtf-fit shards/ -o material/")
    from mbtf_core.data.folder import DataFolder

    folder = DataFolder.open(shards)
    config = resolve_config(options, quality, folder)
    _fit_one(config, folder, output, overwrite, verbose, console)


def _fit_one(
    config: FitConfig,
    shards: DataFolder,
    output: Path,
    overwrite: bool,
    verbose: bool,
    console: Console,
) -> None:
    """Fit a data set, and report."""
    from mbtf_fit.material.format import DESCRIPTION_NAME
    from mbtf_fit.training.endings import describe_ending, describe_kept
    from mbtf_fit.training.fit import fit
    from mbtf_fit.training.next_step import advise

    finished = not overwrite and (output / DESCRIPTION_NAME).exists()
    if not finished:
        _announce(config, [shards], output, f"{shards} -> {output}: {config.model}", console)
    with console.progress(total=100, label="reading", unit="%") as bar:
        result = fit(
            config,
            shards,
            output,
            overwrite=overwrite,
            progress=_training_progress(bar, output),
        )
    if finished:
        console.note(f"{output}: this fit is already finished; --overwrite trains it again")
    advice = advise(result.material, shards, result.history, result.errors)
    summary = {**result.as_dict(), "advice": advice}
    ending = describe_ending(config, result.history)
    kept = describe_kept(result.history, result.kept_step)
    more = [line for line in (kept, ending, advice) if line is not None]
    console.report(summary, "\n".join([describe_fit(summary, verbose), *more]))


def _training_progress(bar: Progress, folder: Path) -> Callable[[str, float, str], None]:
    """Progress of a fit whose checkpoint lies in a folder."""

    def update(phase: str, fraction: float, note: str) -> None:
        if phase == "training" and fraction:
            # Before, there is no checkpoint.
            keep_on_interruption(f"the last checkpoint is kept in {folder}")
        bar.update(round(100 * fraction, 1), note, label=phase)

    return update


def _announce(
    config: FitConfig, shards: Sequence[Path | DataFolder], output: Path, what: str, console: Console
) -> None:
    """State the time of a fit, and refuse one that the disk cannot hold."""
    from mbtf_core.files.folders import check_space
    from mbtf_fit.native import missing_reason
    from mbtf_fit.training.suitable_data import open_data

    data = [open_data(folder, config.model) for folder in shards]
    size = sum(_fit_bytes(config, one.lattice) for one in data)
    check_space(output, size, "reduce network.channels, or choose another folder with -o")
    training = config.training
    budget = training.time if training.steps is None else f"{training.steps} steps"
    queries = sum(int(one.manifest["splits"]["train"].get("queries", 0)) for one in data)
    # Reading, hints, energy calibration, errors, distillation and writing: of the default model at 64 and 128
    # texels, on two free cores.
    beside = 8.0 + 0.7e-6 * queries
    console.note(
        f"{what}, training for {budget} (change it with --time or --steps); reading, calibration and errors "
        f"take about {beside:.0f} s beside it"
    )
    if missing := missing_reason():
        console.note(f"note: training runs in PyTorch, not in the compiled kernel ({missing})")


def _fit_bytes(config: FitConfig, lattice: Lattice) -> int:
    """Bytes that a fit writes at most: a checkpoint of weights, two moments and the best weights, while it
    replaces another, and the known surface."""
    import torch

    from mbtf_fit.models.registry import material_of
    from mbtf_fit.surface.known import surface_bytes

    with torch.device("meta"):
        model = material_of(config.model, lattice, config.network)
    surface = surface_bytes(lattice) if model.tracing is not None else 0
    return 8 * sum(p.nbytes for p in model.parameters()) + surface


def resolve_config(
    options: Options[FitConfig], quality: Quality | None, *shards: Path | DataFolder
) -> FitConfig:
    """Configuration that a command line asks for, of a fit or of one of several data sets. Without a model
    among the options, the network to keep decides, or the data sets."""
    from mbtf_fit.config import fitter_options

    overrides = options.explicit()
    kept = _kept_options(overrides.get("decoder"))
    overrides = {"model": kept.get("model") or _model_for(shards), **overrides}
    presets = {"model": overrides["model"]}
    if quality is not None:
        presets |= fitter_options(quality, {"": overrides})[""]
    if overrides["model"] == kept.get("model"):
        presets |= kept
    return options.resolve(presets)


def _kept_options(folder: object) -> dict[str, Any]:
    """Options of the network that a fit keeps, by dotted key; none without one."""
    if not isinstance(folder, str):
        return {}
    from mbtf_fit.material.decoder import Decoder

    return Decoder.find(folder).options()


def _model_for(shards: Sequence[Path | DataFolder]) -> ModelName:
    """The model that is best for a data set, or for several that share a network."""
    from mbtf_core.data.dataset import Dataset

    try:
        records = [Dataset.open(folder).manifest["geometry"] or {} for folder in shards]
    except InputError:  # the fit refuses it, with the reason
        return DEFAULT_MODEL
    return best_model([record.get("channels", ()) for record in records])


def _fit_many(
    options: FitOptions,
    quality: Quality | None,
    many: list[Path],
    output: Path,
    cluster: str | None,
    overwrite: bool,
    console: Console,
) -> None:
    """Fit several data sets, each on its own or all with one network."""
    from mbtf_fit.training.fit_many import find_data, material_folders

    shards = find_data(many)
    folders = material_folders(shards, output)
    config = resolve_config(options, quality, *shards)
    if not config.training.shared_decoder:
        configs = [resolve_config(options, quality, folder) for folder in shards]
        _fit_each(configs, shards, folders, output, cluster, overwrite, console)
        return
    if cluster is not None:
        raise UsageError("a shared network is one fit: leave out --cluster")
    from mbtf_fit.training.endings import describe_kept
    from mbtf_fit.training.fit import fit_jointly

    what = f"{len(shards)} data sets -> {output}: {config.model} with a shared network"
    _announce(config, shards, output, what, console)
    with console.progress(total=100, label="reading", unit="%") as bar:
        results = fit_jointly(
            config,
            shards,
            folders,
            overwrite=overwrite,
            progress=_training_progress(bar, output),
        )
    fits = [fitted.as_dict() for fitted in results]
    outcomes = [
        {"shards": str(data), "material": fitted["material"], "result": fitted, "error": None}
        for data, fitted in zip(shards, fits, strict=True)
    ]
    lines = [fits_table({folder.name: fitted for folder, fitted in zip(folders, fits, strict=True)})]
    for folder, fitted in zip(folders, results, strict=True):
        if (kept := describe_kept(fitted.history, fitted.kept_step)) is not None:
            lines.append(f"{folder.name}: {kept}")
    console.report({"fits": outcomes}, "\n".join(lines))


def _fit_each(
    configs: Sequence[FitConfig],
    shards: Sequence[Path],
    folders: Sequence[Path],
    output: Path,
    cluster: str | None,
    overwrite: bool,
    console: Console,
) -> None:
    """Fit several data sets, in processes of their own, one per GPU at a time, or on a cluster."""
    import torch

    from mbtf_core.run.cluster import open_runner
    from mbtf_core.run.processes import Processes
    from mbtf_fit.training.fit_many import fit_many

    processes = max(1, torch.cuda.device_count()) if configs[0].device != "cpu" else 1
    models = " and ".join(sorted({config.model for config in configs}))
    console.note(f"{len(shards)} data sets -> {output}: {models}")
    keep_on_interruption(f"finished fits and the last checkpoints are kept in {output}")
    with (
        open_runner(cluster, console.note, Processes(processes)) as runner,
        console.progress(total=len(shards), label="fitting", unit="data sets") as bar,
    ):

        def finished(folder: Path, error: str | None) -> None:
            bar.advance(1, f"{folder.name}: {'failed' if error else 'done'}")

        outcomes = fit_many(configs, shards, folders, runner, overwrite=overwrite, finished=finished)
    results = [outcome["result"] for outcome in outcomes]
    table = fits_table({folder.name: found for folder, found in zip(folders, results, strict=True)})
    console.report({"fits": outcomes}, table)
    failed = [outcome for outcome in outcomes if outcome["error"] is not None]
    for outcome in failed:
        console.note(f"{outcome['shards']}: {outcome['error']}")
    if failed:
        raise PartialError(
            f"{len(failed)} of {len(outcomes)} fits failed",
            where=output,
            hint="the same command resumes the others",
        )
