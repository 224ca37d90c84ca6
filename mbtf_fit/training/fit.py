"""From shards to a material: one fit, started or resumed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.errors import InputError, PartialError
from mbtf_core.files.folders import ELSEWHERE, owned
from mbtf_core.run.signals import stop_on_interruption
from mbtf_core.stats import pooled_variance
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition, load_training, open_data
from mbtf_fit.data.queries import ShardQueries, mean_value
from mbtf_fit.evaluation import evaluate_splits
from mbtf_fit.material.decoder import Decoder
from mbtf_fit.material.format import DESCRIPTION_NAME
from mbtf_fit.material.material import Material, export
from mbtf_fit.material.transmittance import evaluate_transmittance, fit_transmittance
from mbtf_fit.models.model import Model, Preparation
from mbtf_fit.models.registry import MODELS, material_of
from mbtf_fit.objective.noise import NoiseModel, typical_value
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.training.checkpoint import CHECKPOINT_NAME, read_checkpoint, write_checkpoint
from mbtf_fit.training.convergence import MarginalCost, marginal_cost_of
from mbtf_fit.training.device import choose_device, keep_freed_memory
from mbtf_fit.training.fit_folder import claim, identity_of
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.trainer import Trainer, TrainingData
from mbtf_fit.training.validation import (
    append_history,
    describe_record,
    history_record,
    read_history,
    truncate_history,
    validation_set,
    validation_subset,
)

# Seconds of training between two validations, and between two checkpoints.
_REPORT_SECONDS = 2.0
_CHECKPOINT_SECONDS = 15.0
# Tensors that ``init_from`` copies, by the first part of their names; the decoder keeps its initialization.
_SHARED = ("pyramid", "offset_texture", "offset_network")
# Displacement of `relief`, copied from materials that have it.
_DEPTH_WEIGHTS = "depth_weights"

# Called with the fraction of the budget that is spent, and one line of text.
Observer = Callable[[dict[str, Any], Trainer, ShardQueries], None]
ProgressCallback = Callable[[float, str], None]


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

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON, without the history."""
        cost = self.marginal_cost
        return {
            "material": str(self.folder),
            "model": self.material.config.model,
            "seconds": self.seconds,
            "total_seconds": self.total_seconds,
            "resumed": self.resumed,
            "training": self.material.description["training"],
            "errors": self.errors,
            "marginal_cost": None if cost is None else asdict(cost),
        }

    @property
    def marginal_cost(self) -> MarginalCost | None:
        """Estimated training time that halves the error; None where the history does not resolve it."""
        training = self.material.description["training"]
        return marginal_cost_of(
            self.history, self.errors, training.get("noise_variance"), training.get("validation_set", "test")
        )


def check_options(config: FitConfig) -> None:
    """Refuse losses, and a network to keep, that the model cannot have."""
    if config.decoder is not None:
        Decoder.find(config.decoder).check(config)
    gradient = any(term.kind == "gradient" for term in config.training.losses)
    if MODELS[config.model].layout != "image" and gradient:
        raise InputError(
            f"the gradient loss compares neighboring texels, which {config.model} never sees together",
            where="training.losses",
            hint="use another loss, or a model that learns from the image layout",
        )


def _check_folder(config: FitConfig, out: Path) -> None:
    """Refuse to replace the network or the material that the fit reads."""
    read = []
    if config.decoder is not None:
        read.append(Decoder.find(config.decoder).folder)
    if config.init_from is not None:
        read.append(Path(config.init_from))
    if out.resolve() in (folder.resolve() for folder in read):
        raise InputError("holds what the fit starts from", where=out, hint=ELSEWHERE)


def fit(
    config: FitConfig,
    shards: str | Path | DataFolder,
    out: str | Path,
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    observe: Observer | None = None,
    partition: Partition | None = None,
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
        Called with the fraction of the budget that is spent, in [0, 1], and one line of text.
    observe : callable, optional
        Called after each validation with its record, the trainer, and the queries of the validation.
    partition : Partition, optional
        Result of :func:`~mbtf_fit.data.loader.load_training` for these data, held-out settings and seed, to
        share among several fits; read from `shards` by default.

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
    begin = time.perf_counter()
    if config.training.shared_decoder:
        raise InputError(
            "a shared network takes several data sets",
            where="training.shared_decoder",
            hint="mbtf-fit --many SHARDS SHARDS --shared-decoder -o materials/",
        )
    device = choose_device(config.device)
    out = Path(out)
    check_options(config)
    _check_folder(config, out)
    data = open_data(shards, MODELS[config.model].layout, config.model, config.data.cache)
    identity = identity_of(config, data)
    with owned(out):
        claim(out, identity, config, overwrite)
        progress = progress or (lambda fraction, note: None)
        finished = (out / DESCRIPTION_NAME).exists()
        resumed = finished or _fit(config, data, identity, partition, device, out, progress, observe)
        return result_of(out, time.perf_counter() - begin, resumed=resumed)


def _fit(
    config: FitConfig,
    data: Dataset,
    identity: dict[str, Any],
    partition: Partition | None,
    device: torch.device,
    out: Path,
    progress: ProgressCallback,
    observe: Observer | None,
) -> bool:
    """Train and export; whether an earlier run was resumed."""
    keep_freed_memory()
    if partition is None:
        partition = load_training(data, config.held_out, config.seed, config.data.memory)
    trainer = prepare_trainer(config, data, partition, device)
    resumed = _resume(trainer, out)
    name, queries = validation_set(data, partition)
    subset = validation_subset(trainer.model.positions, queries)
    del queries
    _train(trainer, subset, out, progress, observe)
    kept = None if config.decoder is None else {"decoder": {"sha256": Decoder.find(config.decoder).sha256}}
    export_fit(trainer, config, data, partition, identity, out, validated=name, more=kept)
    (out / CHECKPOINT_NAME).unlink(missing_ok=True)
    return resumed


def export_fit(
    trainer: Trainer,
    config: FitConfig,
    data: Dataset,
    partition: Partition,
    identity: dict[str, Any],
    out: Path,
    *,
    validated: str,
    more: dict[str, Any] | None = None,
) -> None:
    """Write the material of a finished training, with its errors.

    Parameters
    ----------
    identity : content of ``fit.json``
    validated : name of the set of the validations
    more : what the summary of the training says besides, or otherwise
    """
    trainer.fill_levels(float(level_of_sigma(partition.sample.sigma.max())))
    trainer.calibrate()
    errors = evaluate_splits(trainer.predict, data, partition)
    variance = errors["training"].overall.variance.value
    sample = partition.sample
    noise = pooled_variance(sample.value_a, sample.value_b).value if data.estimates == 2 else None
    training = {
        "steps": trainer.progress.step,
        "batch": trainer.batch,
        "queries": len(partition.training),
        "seconds": round(trainer.progress.seconds, 3),
        "loss": trainer.progress.loss,
        "validation_set": validated,
        "weight_decay": asdict(trainer.weight_decay),
        "coverage": {str(level): fraction for level, fraction in trainer.coverage().items()},
        "device": str(trainer.device),
        "threads": torch.get_num_threads(),
        "backend": trainer.backend,
        "torch": torch.__version__,
        "errors": {split: e.as_dict() for split, e in errors.items()},
        # Variance of the noise of values, in 1/sr² and over that of the values; null where it is unknown.
        "noise_variance": noise,
        "noise_ratio": noise / variance if noise is not None and variance > 0 else None,
    }
    transmittance = fit_transmittance(data, partition.selection)
    if transmittance is not None:
        found = evaluate_transmittance(transmittance, data, partition.selection)
        training["transmittance"] = {split: e.as_dict() for split, e in found.items()}
    training |= more or {}
    export(trainer.model, config, out, data=identity["data"], training=training, transmittance=transmittance)


def prepare_trainer(
    config: FitConfig,
    data: Dataset,
    partition: Partition,
    device: torch.device,
    shared: NeuralMaterial | None = None,
) -> Trainer:
    """A trainer at its first step, for the model and the data of a configuration; with the networks of the
    model `shared`, if there is one."""
    model = material_of(config.model, data.lattice, config.network)
    unit = typical_value(mean_value(partition.sample.value_a, partition.sample.value_b))
    model.initialize(torch.Generator().manual_seed(config.seed), unit)

    def load(folder: str) -> tuple[TrainingData, float]:
        other = open_data(folder, MODELS[config.model].layout, config.model, config.data.cache)
        part = load_training(other, config.held_out, config.seed)
        typical = typical_value(mean_value(part.sample.value_a, part.sample.value_b))
        return part.training.to(device), typical

    hooks, training = MODELS[config.model](model), partition.training.to(device)
    training = hooks.prepare(Preparation(data, training, config.training, unit, config.seed, load))
    if config.init_from is not None:
        _initialize_from(hooks, config.init_from)
    if config.decoder is not None:
        Decoder.find(config.decoder).load(model)
    noise = NoiseModel.silent(unit, data.lattice)
    # A single value does not tell its noise; none is assumed.
    if data.estimates == 2:
        noise = NoiseModel.of(partition.sample, data.lattice, unit)
    model = model.to(device)
    if shared is not None:
        model.share_networks(shared)
    return Trainer(config, model, training, noise, partition.selection, hooks)


def _initialize_from(hooks: Model, folder: str | Path) -> None:
    """Copy textures and offset of a material into a model of like levels, channels, width and offset.

    A step of the hierarchical model takes several times as long as a step of ``neumip``. Both share textures
    and offset, which ``neumip`` learns sooner.
    """
    model, source = hooks.material, Material.load(folder).model
    given, mine = source.weights(), model.weights()
    names = [name for name in mine if name.partition(".")[0] in _SHARED]
    names += [_DEPTH_WEIGHTS] if _DEPTH_WEIGHTS in mine and _DEPTH_WEIGHTS in given else []
    for name in names:
        if name not in given or given[name].shape != mine[name].shape:
            raise InputError(
                f"its '{name}' does not have the shape that the fit needs",
                where=folder,
                hint="fit it with the same levels, network.channels, network.width, network.layers, "
                "network.offset and network.oversampling",
            )
    model.load_weights({**mine, **{name: given[name] for name in names}})
    hooks.init_from(source)


def _resume(trainer: Trainer, out: Path) -> bool:
    """Resume from the checkpoint, if there is one."""
    path = out / CHECKPOINT_NAME
    resumed = path.exists()
    if resumed:
        read_checkpoint(trainer, path)
    truncate_history(out, trainer.progress.step)
    return resumed


def _train(
    trainer: Trainer,
    subset: ShardQueries,
    out: Path,
    progress: ProgressCallback,
    observe: Observer | None,
) -> None:
    def report() -> None:
        record = history_record(trainer, subset)
        append_history(out, record)
        progress(trainer.fraction, describe_record(record))
        if observe is not None:
            observe(record, trainer, subset)

    run_training(trainer, report, lambda: write_checkpoint(trainer, out / CHECKPOINT_NAME))


def run_training(
    loop: TrainingLoop, report: Callable[[], None], save: Callable[[], None], *, reports: float = 1.0
) -> None:
    """Spend the budget of a loop, with reports and checkpoints at intervals; `reports` is a factor on the
    interval of the reports.

    Raises
    ------
    KeyboardInterrupt : the program is interrupted; a checkpoint is written first
    """
    saved = time.perf_counter()
    done = loop.fraction >= 1.0
    with stop_on_interruption() as stop:
        while not (done or stop.is_set()):
            try:
                done = loop.train(reports * _REPORT_SECONDS, stop)
            except PartialError:
                # The store of streamed queries cannot be reached.
                save()
                raise
            report()
            if time.perf_counter() - saved > _CHECKPOINT_SECONDS or done or stop.is_set():
                save()
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
