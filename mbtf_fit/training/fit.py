"""From data sets to materials: one fit, or one of several materials that share their network."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.folder import DataFolder
from mbtf_core.errors import InputError, PartialError, check_type
from mbtf_core.files.folders import ELSEWHERE, owned
from mbtf_core.paths import real_path
from mbtf_core.run.signals import stop_on_interruption
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition, load_training
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.formatting import format_estimate, headline
from mbtf_fit.material.decoder import Decoder
from mbtf_fit.material.format import DESCRIPTION_NAME
from mbtf_fit.material.material import Material
from mbtf_fit.training.best_state import lower_bound
from mbtf_fit.training.endings import describe_validations, kept_step, reached
from mbtf_fit.training.fit_export import Member, export_fits
from mbtf_fit.training.fit_folder import (
    append_history,
    claim,
    identity_of,
    read_history,
    truncate_history,
)
from mbtf_fit.training.loop import (
    CHECKPOINT_NAME,
    TrainingLoop,
    choose_device,
    keep_freed_memory,
    read_checkpoint,
    write_checkpoint,
)
from mbtf_fit.training.suitable_data import open_data
from mbtf_fit.training.trainer import Trainer, prepare_trainer
from mbtf_fit.training.validation import (
    MarginalCost,
    history_record,
    marginal_cost_of,
    validation_set,
    validation_subset,
)

# Seconds of training between two validations of so many materials, and between two checkpoints.
_REPORT_SECONDS, _VALIDATED = 2.0, 4
_CHECKPOINT_SECONDS = 15.0

# Called with a phase, the fraction of it that is done, and one line of text.
ProgressCallback = Callable[[str, float, str], None]


@dataclass(frozen=True)
class FitResult:
    """Result of :func:`fit`.

    Attributes
    ----------
    material : Material
        The fitted material, as read from its folder.
    folder : Path
        Folder of the material.
    history : list of dict
        Records of the validations, see :func:`read_history`.
    seconds : float
        Training time over all runs, in seconds.
    total_seconds : float
        Time of this run in seconds, loading and evaluation included.
    errors : dict
        Errors by split: ``test``, ``held_out_queries``, ``held_out_directions``, ``training``.
    resumed : bool
        Whether an earlier run was resumed.
    """

    material: Material
    folder: Path
    history: list[dict[str, Any]]
    seconds: float
    total_seconds: float
    errors: dict[str, dict[str, Any]]
    resumed: bool

    def __repr__(self) -> str:
        error = ""
        if self.errors:
            first = headline(self.errors)
            error = f", unexplained variance {format_estimate(self.errors[first]['unexplained'])}"
        return f"<FitResult {self.folder}: {self.material.model.name}, {self.seconds:.0f} s{error}>"

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, without the history."""
        cost = self.marginal_cost
        return {
            "material": str(self.folder),
            "model": self.material.model.name,
            "seconds": self.seconds,
            "total_seconds": self.total_seconds,
            "resumed": self.resumed,
            "reached": reached(self.material.config, self.history),
            "training": self.material.description["training"],
            "errors": self.errors,
            "marginal_cost": None if cost is None else cost.as_dict(),
        }

    @property
    def marginal_cost(self) -> MarginalCost | None:
        """Expected gain by longer training and by more data; None where the history is incomplete."""
        return marginal_cost_of(self.history, self.errors, self.material.description["training"])

    @property
    def kept_step(self) -> int | None:
        """Step of the state that is kept, if it is not the last: later, the fit overfitted."""
        return kept_step(self.material.description["training"])


def _check_folder(config: FitConfig, out: Path) -> None:
    """Refuse a network of another architecture, and to replace what the fit reads."""
    if config.decoder is None:
        return
    Decoder.find(config.decoder).check(config)
    if real_path(out) == real_path(config.decoder):
        raise InputError("holds what the fit starts from", where=out, hint=ELSEWHERE)


def fit(
    config: FitConfig,
    shards: str | Path | DataFolder,
    out: str | Path,
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> FitResult:
    """Fit a model to a data set and export it as a material.

    An unfinished fit of the same configuration and data is resumed; a finished one is kept.

    Parameters
    ----------
    config : FitConfig
        Options of the fit.
    shards : str or Path
        Folder made by ``mbtf-gen``, or its URL.
    out : str or Path
        Folder of the material.
    overwrite : bool
        Replace a fit of another configuration.
    progress : callable, optional
        Called with the phase (``reading``, ``preparing``, ``training``, ``calibrating``, ``predicting``,
        ``distilling``, ``writing``), the fraction of it that is done, in [0, 1], and one line of text.

    Returns
    -------
    FitResult
        The material, its errors and its history.

    Raises
    ------
    InputError
        Shards or folder cannot be used, or training diverged.
    EngineError
        The device is not available.
    PartialError
        The disk is full, another process writes to the folder, or the store cannot be reached; the same
        command resumes.
    """
    check_type(config, FitConfig, "config", "such as FitConfig(training={'time': '2min'})")
    check_type(out, (str, os.PathLike), "out", "give the path of a folder")
    if config.training.shared_decoder:
        raise InputError(
            "a shared network takes several data sets",
            where="training.shared_decoder",
            hint="mbtf-fit --many SHARDS SHARDS --shared-decoder -o materials/",
        )
    out = Path(out)
    _check_folder(config, out)
    return _fit(config, [shards], [out], overwrite, progress)[0]


def fit_jointly(
    config: FitConfig,
    shards: Sequence[str | Path],
    folders: Sequence[str | Path],
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
) -> list[FitResult]:
    """Fit a material to each of several data sets, all with one network.

    Textures, surfaces, depth weights and calibration factors are those of each material. An unfinished fit of
    the same configuration and data sets is resumed; a finished one is kept.

    Parameters
    ----------
    config : FitConfig
        Options of the fit, with ``training.shared_decoder``; the budget is that of all materials together.
    shards : sequence of str or Path
        Folders made by ``mbtf-gen``, two at least.
    folders : sequence of str or Path
        Folder of each material; the first one has the checkpoint.
    overwrite : bool
        Replace fits of another configuration.
    progress : callable, optional
        As of :func:`fit`.

    Returns
    -------
    list of FitResult
        Of each material, in the order of the data sets.

    Raises
    ------
    InputError, EngineError, PartialError
        As :func:`fit`; or there are too few data sets.
    """
    check_type(config, FitConfig, "config", "such as FitConfig(training={'shared_decoder': True})")
    check_type(shards, (list, tuple), "shards", "give a list of folders")
    check_type(folders, (list, tuple), "folders", "give a list of folders")
    outs = [Path(folder) for folder in folders]
    if not config.training.shared_decoder:
        raise InputError("is not set", where="training.shared_decoder", hint="set it to true")
    if len(shards) < 2:
        raise InputError(
            "a shared network takes two data sets at least",
            hint="mbtf-fit --many SHARDS SHARDS --shared-decoder -o materials/",
        )
    for name, count in Counter(out.name for out in outs).items():
        if count > 1:
            raise InputError(f"{count} of the folders have this name", where=name, hint="rename them")
    return _fit(config, shards, outs, overwrite, progress)


def _fit(
    config: FitConfig,
    shards: Sequence[str | Path | DataFolder],
    folders: Sequence[Path],
    overwrite: bool,
    progress: ProgressCallback | None,
) -> list[FitResult]:
    """Fit materials to data sets; the first folder has the checkpoint."""
    begin = time.perf_counter()
    device = choose_device(config.device)
    shared = config.training.shared_decoder
    data = [open_data(folder, config.model, config.data.cache) for folder in shards]
    group = data if shared else ()
    members = [
        Member(out, one, identity_of(config, one, group)) for out, one in zip(folders, data, strict=True)
    ]
    checkpoint = folders[0] / CHECKPOINT_NAME
    with ExitStack() as stack:
        for folder in folders:
            stack.enter_context(owned(folder))
        for member in members:
            # A fit that fails before its first checkpoint leaves no folder.
            stack.enter_context(claim(member.folder, member.identity, config, overwrite))
        finished = all((folder / DESCRIPTION_NAME).exists() for folder in folders)
        # A joint fit that was killed may have exported a part of its materials anew.
        finished = finished and not (shared and checkpoint.exists())
        resumed = finished or _train(
            config, members, checkpoint, device, progress or (lambda phase, fraction, note: None)
        )
        checkpoint.unlink(missing_ok=True)
        total = time.perf_counter() - begin
        return [result_of(folder, total, resumed=resumed) for folder in folders]


def _train(
    config: FitConfig,
    members: Sequence[Member],
    checkpoint: Path,
    device: torch.device,
    progress: ProgressCallback,
) -> bool:
    """Train and export; whether an earlier run was resumed."""
    keep_freed_memory()
    # The memory is that of all data sets together.
    memory = config.data.model_copy(update={"memory": config.data.memory / len(members)})
    own = config.model_copy(update={"data": memory})
    trainers: list[Trainer] = []
    partitions: list[Partition] = []
    subsets: list[tuple[str, ShardQueries]] = []
    for member in members:
        progress("reading", 0.0, str(member.data.folder))
        part = load_training(member.data, own.held_out, own.seed, own.data.memory)
        progress("preparing", 0.0, str(member.data.folder))
        network = trainers[0].model if trainers else None
        trainers.append(prepare_trainer(own, member.data, part, device, network))
        partitions.append(part)
        name, queries = validation_set(member.data, part)
        subsets.append((name, validation_subset(trainers[-1].model.positions, queries)))
        del queries
    names = [member.folder.name for member in members] if len(members) > 1 else [""]
    validation = [queries for _, queries in subsets]
    loop = TrainingLoop(trainers, names)
    resumed = checkpoint.exists()
    if resumed:
        read_checkpoint(loop, checkpoint)
    for member in members:
        truncate_history(member.folder, loop.progress.step)

    def report() -> bool:
        records = []
        predictions = [
            trainer.predict(queries) for trainer, queries in zip(trainers, validation, strict=True)
        ]
        before: Sequence[Any] = loop.validated[1] or [None] * len(trainers)
        if all(map(len, validation)):
            loop.validate(predictions, validation)
        for member, trainer, subset, predicted, previous in zip(
            members, trainers, validation, predictions, before, strict=True
        ):
            records.append(history_record(trainer, subset, predicted, previous))
            append_history(member.folder, records[-1])
        progress("training", loop.fraction, describe_validations(records))
        return all(reached(config, [record]) for record in records)

    progress("training", loop.fraction, "")
    # A fit that was killed after it had reached its error is exported as it is.
    if not all(reached(config, read_history(member.folder)) for member in members):
        _spend_budget(loop, report, checkpoint)
    trained = loop.progress
    kept = loop.keep_best(validation)
    for trainer, queries, prediction in zip(trainers, validation, kept, strict=True):
        lower_bound(trainer, queries, prediction)
    export_fits(
        config,
        loop,
        trained,
        members,
        partitions,
        [name for name, _ in subsets],
        progress,
    )
    return resumed


def _spend_budget(loop: TrainingLoop, report: Callable[[], bool], checkpoint: Path) -> None:
    """Train with reports and checkpoints at intervals, until the budget is spent or a report says that the
    error is reached; a checkpoint is written before an interruption ends it."""
    seconds = max(1.0, len(loop.trainers) / _VALIDATED) * _REPORT_SECONDS
    saved = time.perf_counter()
    done = loop.fraction >= 1.0
    with stop_on_interruption() as stop:
        while not (done or stop.is_set()):
            try:
                done = loop.train(seconds, stop, pause=True)
            except PartialError:
                # The store of streamed queries cannot be reached.
                write_checkpoint(loop, checkpoint)
                raise
            done = report() or done
            if time.perf_counter() - saved > _CHECKPOINT_SECONDS or done or stop.is_set():
                write_checkpoint(loop, checkpoint)
                saved = time.perf_counter()
        if stop.is_set():
            raise KeyboardInterrupt


def result_of(out: Path, total: float, *, resumed: bool) -> FitResult:
    """Result of a finished fit in a folder; `total`: seconds of this run."""
    material = Material.load(out)
    training = material.description["training"]
    return FitResult(
        material, out, read_history(out), training["seconds"], round(total, 3), training["errors"], resumed
    )
