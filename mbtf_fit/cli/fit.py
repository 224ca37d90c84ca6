"""``mbtf-fit SHARDS``: fit a material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import (
    ClusterOption,
    DryRun,
    Options,
    Output,
    Overwrite,
    Quality,
    QualityOption,
    Switch,
    Verbose,
    options_from,
)
from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.run.signals import keep_on_interruption
from mbtf_core.units import expectation, format_duration
from mbtf_fit.cli.live import Live, live_view
from mbtf_fit.config import DEFAULT_MODEL, FIBER_MODEL, FitConfig, ModelName, decoder_models
from mbtf_fit.formatting import describe_fit, fits_table


@options_from(FitConfig)
class FitOptions(Options[FitConfig]):
    """Options of ``mbtf-fit``."""


if TYPE_CHECKING:
    from mbtf_core.data.folder import DataFolder


def fit(
    shards: Path | None = None,
    /,
    *,
    output: Output = Path("material"),
    quality: QualityOption = None,
    options: FitOptions = FitOptions(),  # noqa: B008
    many: Annotated[list[Path] | None, Parameter(consume_multiple=True)] = None,
    processes: Annotated[int | None, Parameter(show_default="one per GPU, or 1")] = None,
    shared_decoder: Switch = False,
    live: Live = False,
    tensorboard: Annotated[Path | None, Parameter(metavar="FOLDER")] = None,
    cluster: ClusterOption = None,
    dry_run: DryRun = False,
    overwrite: Overwrite = False,
    verbose: Verbose = False,
    console: Console = CONSOLE,
) -> None:
    """Fit a material to a data set: mbtf-fit shards/ -o material/

    The same command again resumes an unfinished fit. --time is that of training. --dry-run forecasts time,
    size and a bound of the error by a short fit on this machine. With --many, the output folder holds one
    folder per material.

    Parameters
    ----------
    shards
        Folder made by mbtf-gen, or its URL.
    many
        Fit several data sets, one material each: folders made by mbtf-gen, folders of such folders, or text
        files with one folder per line. A fit that fails does not stop the others.
    processes
        With --many, number of simultaneous fits.
    shared_decoder
        With --many, fit all data sets together with one network, which is also written to the folder decoder/
        of the output. --time is that of all of them.
    tensorboard
        Write the curves of the fit as event files for TensorBoard to a folder.
    """
    if dry_run and many is not None:
        raise UsageError("--dry-run takes one data set", hint="mbtf-fit shards/ --dry-run")
    if many is not None and shards is not None:
        raise UsageError(
            "--many replaces the argument SHARDS", hint=f"mbtf-fit --many {shards} ... -o materials/"
        )
    if processes is not None and (many is None or processes < 1):
        raise UsageError("--processes must be a positive number and requires --many")
    if cluster is not None and (many is None or processes is not None):
        hint = "leave out --processes" if many is not None else "mbtf-fit --many shards/ -o materials/"
        raise UsageError("requires --many, and sets the number of processes", where="--cluster", hint=hint)
    if shared_decoder and many is None:
        raise UsageError("--shared-decoder requires --many", hint="mbtf-fit --many a/ b/ --shared-decoder")
    if shards is None and many is None:
        raise UsageError("no shards given", hint="mbtf-fit shards/ -o material/")
    for flag, used in (("--live", live), ("--tensorboard", tensorboard is not None)):
        if many is not None and used:
            raise UsageError("shows one fit", where=flag, hint=f"leave out --many, or {flag}")
    if many is not None:
        if shared_decoder:
            options = options.assigning("training.shared_decoder=true")
        _fit_many(options, quality, many, output, processes, cluster, overwrite, console)
        return
    assert shards is not None
    from mbtf_core.data.folder import DataFolder

    data_folder = DataFolder.open(shards)
    resolved = resolve_config(options, quality, data_folder)
    if dry_run:
        from mbtf_fit.training.forecast import forecast_fit

        expected = forecast_fit(resolved, data_folder)
        console.report(
            {"shards": str(data_folder), "model": resolved.model, "forecast": asdict(expected)},
            expected.describe(),
        )
        return
    from mbtf_core.files.folders import check_space
    from mbtf_core.forecast import is_long
    from mbtf_fit.data.loader import open_data
    from mbtf_fit.material.format import DESCRIPTION_NAME
    from mbtf_fit.models.registry import MODELS
    from mbtf_fit.native import missing_reason
    from mbtf_fit.training.fit import fit
    from mbtf_fit.training.forecast import evaluation_seconds, fit_bytes, training_seconds

    finished = not overwrite and (output / DESCRIPTION_NAME).exists()
    partition = None
    if not finished:
        data = open_data(data_folder, MODELS[resolved.model].layout, resolved.model)
        size = fit_bytes(resolved, data.lattice)
        check_space(output, size, "reduce network.channels, or choose another folder with -o")
        training = resolved.training
        budget = format_duration(training.time) if training.steps is None else f"{training.steps} steps"
        console.note(
            f"{data_folder} -> {output}: {resolved.model}, training for {budget} "
            "(change it with --time or --steps)"
        )
        seconds, partition = training_seconds(resolved, data_folder)
        queries = int(data.manifest["splits"]["train"].get("queries", 0))
        seconds += evaluation_seconds(queries)
        if is_long(seconds, size):
            console.note(expectation(seconds, size))
    if missing := missing_reason():
        console.note(f"note: training runs in PyTorch, not in the compiled kernel ({missing})")
    from mbtf_fit.training.tensorboard import EventLog

    keep_on_interruption(f"the last checkpoint is kept in {output}")
    with (
        nullcontext() if tensorboard is None else EventLog(tensorboard) as log,
        live_view(str(output), live, console) as shown,
        console.progress(total=100, label="fitting", unit="%") as bar,
    ):
        curves = None if shown is None else shown.observer(output.name)
        observers = [observer for observer in (curves, log) if observer is not None]

        def observe(*validation: Any) -> None:
            for observer in observers:
                observer(*validation)

        result = fit(
            resolved,
            data_folder,
            output,
            overwrite=overwrite,
            progress=lambda fraction, note: bar.update(round(100 * fraction, 1), note),
            observe=observe if observers else None,
            partition=partition,
        )
        if shown is not None:
            shown.finished(output.name, output)
    if finished:
        console.note(f"{output}: this fit is already finished; --overwrite trains it again")
    summary = result.as_dict()
    cost = [result.marginal_cost.describe()] if result.marginal_cost is not None else []
    console.report(summary, "\n".join([describe_fit(summary, verbose), *cost]))


def resolve_config(
    options: Options[FitConfig], quality: Quality | None, *shards: Path | DataFolder
) -> FitConfig:
    """Configuration of a fit, or of one of several data sets. Without a model among the options, the network
    to keep decides, or the data sets."""
    from mbtf_fit.presets import fitter_options

    overrides = options.explicit()
    kept = _kept_options(overrides.get("decoder"))
    overrides = {"model": kept.get("model") or _model_for(shards), **overrides}
    presets = {"model": overrides["model"]}
    if quality is not None:
        presets |= fitter_options(quality, {"": overrides})[""]
    if overrides["model"] == kept.get("model"):
        presets |= kept
    if "training.time" in options.given:
        # A time overrides the steps of a file or a preset.
        presets["training.steps"] = None
    return options.resolve(presets)


def _shares_decoder(options: Options[FitConfig]) -> bool:
    """Whether the data sets of a command share a network."""
    training = options.explicit().get("training")
    # Values of --set are text.
    return isinstance(training, Mapping) and str(training.get("shared_decoder")).lower() == "true"


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
        known = all(Dataset.open(folder).manifest["geometry"] is not None for folder in shards)
    except InputError:  # the fit refuses it, with the reason
        known = True
    if known:
        return DEFAULT_MODEL
    return FIBER_MODEL if len(shards) == 1 else decoder_models()[-1]


def _fit_jointly(
    config: FitConfig,
    shards: list[Path],
    folders: list[Path],
    output: Path,
    overwrite: bool,
    console: Console,
) -> None:
    from mbtf_core.files.folders import check_space
    from mbtf_fit.data.loader import open_data
    from mbtf_fit.material.decoder import DECODER_FOLDER
    from mbtf_fit.models.registry import MODELS
    from mbtf_fit.training.fit_many import FitOutcome
    from mbtf_fit.training.forecast import fit_bytes
    from mbtf_fit.training.joint_fit import fit_jointly

    training = config.training
    budget = format_duration(training.time) if training.steps is None else f"{training.steps} steps"
    layout = MODELS[config.model].layout
    size = sum(fit_bytes(config, open_data(folder, layout, config.model).lattice) for folder in shards)
    check_space(output, size, "reduce network.channels, or choose another folder with -o")
    console.note(
        f"{len(shards)} data sets -> {output}: {config.model} with a shared network, training for {budget} "
        "(change it with --time or --steps)"
    )
    decoder = output / DECODER_FOLDER
    keep_on_interruption(f"the last checkpoint is kept in {decoder}")
    with console.progress(total=100, label="fitting", unit="%") as bar:
        result = fit_jointly(
            config,
            shards,
            folders,
            decoder,
            overwrite=overwrite,
            progress=lambda fraction, note: bar.update(round(100 * fraction, 1), note),
        )
    outcomes = [
        FitOutcome(data, fitted.folder, fitted.as_dict(), None)
        for data, fitted in zip(shards, result.fits, strict=True)
    ]
    report = {
        "decoder": {"folder": result.decoder.folder, "sha256": result.decoder.sha256},
        "fits": [outcome.as_dict() for outcome in outcomes],
    }
    console.report(report, fits_table({o.folder.name: o.result for o in outcomes}))


def _fit_many(
    options: FitOptions,
    quality: Quality | None,
    many: list[Path],
    output: Path,
    processes: int | None,
    cluster: str | None,
    overwrite: bool,
    console: Console,
) -> None:
    from mbtf_core.run.cluster import open_runner
    from mbtf_core.run.processes import Processes
    from mbtf_fit.training.fit_many import FitOutcome, find_data, fit_many, name_materials

    shards = find_data(many)
    folders = name_materials(shards, output)
    if _shares_decoder(options):
        if processes is not None or cluster is not None:
            flag = "--cluster" if processes is None else "--processes"
            raise UsageError(f"a shared network is one fit: leave out {flag}")
        _fit_jointly(resolve_config(options, quality, *shards), shards, folders, output, overwrite, console)
        return
    configs = [resolve_config(options, quality, folder) for folder in shards]
    if processes is None:
        import torch

        processes = max(1, torch.cuda.device_count()) if configs[0].device != "cpu" else 1
    console.note(
        f"{len(shards)} data set{'s' * (len(shards) != 1)} -> {output}: "
        f"{' and '.join(sorted({config.model for config in configs}))}"
        f"{'' if cluster is not None else f', {processes} at a time'}"
    )
    keep_on_interruption(f"finished fits and the last checkpoints are kept in {output}")
    with (
        open_runner(cluster, console.note, Processes(processes)) as runner,
        console.progress(total=len(shards), label="fitting", unit="data sets") as bar,
    ):

        def finished(outcome: FitOutcome) -> None:
            bar.advance(1, f"{outcome.folder.name}: {'failed' if outcome.error else 'done'}")

        outcomes = fit_many(configs, shards, folders, runner, overwrite=overwrite, finished=finished)
    console.report(
        {"fits": [o.as_dict() for o in outcomes]}, fits_table({o.folder.name: o.result for o in outcomes})
    )
    failed = [o for o in outcomes if o.error is not None]
    for outcome in failed:
        console.note(f"{outcome.shards}: {outcome.error}")
    if failed:
        raise PartialError(
            f"{len(failed)} of {len(outcomes)} fits failed",
            where=output,
            hint="the same command resumes the others",
        )
