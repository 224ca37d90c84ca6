"""From shards to a material: one fit from start (or from where it stopped) to end."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mbtf_core.atomic import read_json, write_json, write_text
from mbtf_core.config_file import dump_yaml
from mbtf_core.digest import data_sha256
from mbtf_core.errors import EngineError, InputError
from mbtf_core.folders import check_folder, make_folder, other_configuration
from mbtf_core.stats import Estimate, pooled_variance, unexplained_variance
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import (
    Partition,
    Queries,
    data_hash,
    load_split,
    load_training,
    mean_value,
    open_data,
)
from mbtf_fit.evaluation import judge
from mbtf_fit.material.export import LAYERS_NAME, TEXTURES_NAME
from mbtf_fit.material.format import DESCRIPTION_NAME, WEIGHTS_NAME
from mbtf_fit.material.material import Material, export
from mbtf_fit.material.storage import read_tensors, write_tensors
from mbtf_fit.material.transmittance import TRANSMITTANCE_NAME
from mbtf_fit.material.transmittance_fit import fit_transmittance, judge_transmittance
from mbtf_fit.models import MODELS, build_model
from mbtf_fit.objective.noise import NoiseModel, typical_value
from mbtf_fit.training.convergence import Price, price_of
from mbtf_fit.training.memory import keep_freed_memory
from mbtf_fit.training.trainer import Trainer
from mbtf_fit.training.warm_start import digest_of, take_over
from mbtf_gen.dataset.reader import Dataset

FIT_NAME = "fit.json"
CONFIG_NAME = "config.yaml"
METRICS_NAME = "metrics.jsonl"
CHECKPOINT_NAME = "checkpoint.safetensors"
_OWN_FILES = (
    FIT_NAME,
    CONFIG_NAME,
    METRICS_NAME,
    CHECKPOINT_NAME,
    DESCRIPTION_NAME,
    WEIGHTS_NAME,
    TRANSMITTANCE_NAME,
    LAYERS_NAME,
    TEXTURES_NAME,
)
_FORMAT = "mbtf-fit"
_SCHEMA = 1
# Seconds of training between two looks at the error, and between two checkpoints.
_REPORT_SECONDS = 2.0
_CHECKPOINT_SECONDS = 15.0
# Queries that are looked at while training, and the fewest of a test split that tells more than queries of
# few paths.
_GLANCE, _FEWEST = 1 << 14, 1 << 12

# Called with the share of the budget that is spent and a note on how it goes.
ProgressCallback = Callable[[float, str], None]


@dataclass(frozen=True)
class FitResult:
    """What :func:`fit` gives.

    Attributes
    ----------
    material : the fitted material, as its folder holds it
    folder : of the material
    history : one record per look at the error: step, seconds, loss, unexplained, …
    seconds : of training, over all runs; total_seconds : of this run, loading and evaluation included
    errors : split → errors; splits ``test``, ``held_out_queries``, ``held_out_directions``
    resumed : whether an earlier run was taken up
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
        return {
            "material": str(self.folder),
            "model": self.material.config.model,
            "seconds": self.seconds,
            "total_seconds": self.total_seconds,
            "resumed": self.resumed,
            "training": self.material.description["training"],
            "errors": self.errors,
            "price": None if self.price is None else self.price.as_dict(),
        }

    @property
    def price(self) -> Price | None:
        """What the last seconds bought; None where the history does not tell."""
        training = self.material.description["training"]
        return price_of(self.history, self.errors, training.get("noise"), training.get("looks_at", "test"))


def choose_device(name: str) -> torch.device:
    """The device to train on; ``auto`` is CUDA where there is one.

    Raises
    ------
    EngineError : CUDA asked for where there is none
    """
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise EngineError(
            "no CUDA device is available", where="--device cuda", hint="use --device cpu or auto"
        )
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def fit(
    config: FitConfig,
    shards: str | Path,
    out: str | Path,
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    partition: Partition | None = None,
) -> FitResult:
    """Fit a model to a data set and export it as a material.

    Parameters
    ----------
    shards : folder made by ``mbtf-gen``
    out : folder of the material; an unfinished fit of the same configuration and data there is resumed, a
        finished one is left as it is
    overwrite : replace a fit of another configuration
    partition : the train split as :func:`~mbtf_fit.data.loader.load_training` gave it for these data, held-out
        settings and seed, for several fits of one data set; read here by default

    Raises
    ------
    InputError : shards or folder cannot be used; training diverged
    EngineError : the device is not there
    PartialError : the disk is full; the same command resumes
    """
    begin = time.perf_counter()
    device = choose_device(config.device)
    out = Path(out)
    layout = MODELS[config.model].layout
    if layout != "image" and any(term.kind == "gradient" for term in config.training.losses):
        raise InputError(
            f"the gradient loss compares neighbors, which {config.model} never sees together",
            where="training.losses",
            hint="take another loss, or a model that learns from the image layout",
        )
    data = open_data(shards, layout, config.model)
    identity = _identity(config, data)
    if config.start is not None:
        identity["config_hash"] = f"{identity['config_hash']}-{digest_of(config.start)}"
    _claim(out, identity, config, overwrite)
    if (out / DESCRIPTION_NAME).exists():
        return _finished(out, time.perf_counter() - begin)
    keep_freed_memory()
    if partition is None:
        partition = load_training(data, config.held_out, config.seed, config.data.memory)
    trainer = prepare_trainer(config, data, partition, device)
    resumed = _resume(trainer, out)
    looks_at, glance = _glance(trainer, data, partition)
    _train(trainer, glance, out, progress or (lambda share, note: None))
    trainer.calibrate()
    training = {
        "steps": trainer.progress.step,
        "batch": trainer.batch,
        "queries": len(partition.training),
        "seconds": round(trainer.progress.seconds, 3),
        "loss": trainer.progress.loss,
        "looks_at": looks_at,
        "pull": asdict(trainer.pull),
        "coverage": {str(level): share for level, share in trainer.coverage().items()},
        "device": str(device),
        "threads": torch.get_num_threads(),
        "path": trainer.path,
        "torch": torch.__version__,
    }
    errors = judge(trainer.predict, data, partition)
    training["errors"] = {name: e.as_dict() for name, e in errors.items()}
    training["noise"] = _noise(partition.sample, errors["training"].overall.variance.value)
    holes = fit_transmittance(data, partition.selection)
    if holes is not None:
        through = judge_transmittance(holes, data, partition.selection)
        training["transmittance"] = {name: e.as_dict() for name, e in through.items()}
    export(trainer.model, config, out, data=identity["data"], training=training, holes=holes)
    (out / CHECKPOINT_NAME).unlink(missing_ok=True)
    return _finished(out, time.perf_counter() - begin, resumed=resumed)


def _noise(sample: Queries, variance: float) -> float | None:
    """Variance of the noise in values over that of the values; None where these have none."""
    return pooled_variance(sample.value_a, sample.value_b).value / variance if variance > 0 else None


def _identity(config: FitConfig, data: Dataset) -> dict[str, Any]:
    files = {split: [e["file"] for e in data.manifest["splits"][split]["shards"]] for split in data.splits}
    described = {"hash": data_hash(data), "levels": data.lattice.finest, "aspect": data.lattice.aspect}
    lengths = {split: len(names) for split, names in files.items()}
    return {
        "format": _FORMAT,
        "schema": _SCHEMA,
        "config_hash": config.hash(data_sha256({**described, "files": files})),
        "config": config.fields(),
        "data": {**described, "shards": lengths, "inputs": data.manifest.get("inputs", {})},
    }


def _claim(out: Path, identity: dict[str, Any], config: FitConfig, overwrite: bool) -> None:
    """Make the folder this fit's own, or check that it already is.

    Raises
    ------
    InputError : it holds something else
    """
    if check_folder(out, lambda path: (path / FIT_NAME).exists(), "fit"):
        old = read_json(out / FIT_NAME)
        if old.get("config_hash") == identity["config_hash"] and not overwrite:
            return
        if not overwrite:
            before, after = (
                {**record.get("config", {}), **{k: record.get(k) for k in ("schema", "data")}}
                for record in (old, identity)
            )
            raise other_configuration(out, "a fit", before, after, "other shards")
        # The description goes first: without it nothing else passes for a finished material.
        for name in (DESCRIPTION_NAME, *_OWN_FILES):
            (out / name).unlink(missing_ok=True)
    make_folder(out)
    write_text(out / CONFIG_NAME, dump_yaml(config.model_dump(mode="json")))
    write_json(out / FIT_NAME, identity)


def prepare_trainer(config: FitConfig, data: Dataset, partition: Partition, device: torch.device) -> Trainer:
    """A trainer at its first step, for the model and the data of a configuration.

    Raises
    ------
    InputError : the material to start from is not there, or has other textures
    """
    model = build_model(config.model, data.lattice, **config.network.model_dump())
    unit = typical_value(mean_value(partition.sample.value_a, partition.sample.value_b))
    model.initialize(torch.Generator().manual_seed(config.seed), unit)
    if config.start is not None:
        take_over(model, config.start)
    noise = NoiseModel.of(partition.sample, data.lattice, unit)
    return Trainer(config, model.to(device), partition.training.to(device), noise, partition.selection)


def _resume(trainer: Trainer, out: Path) -> bool:
    """Take up the checkpoint where there is one.

    Raises
    ------
    InputError : it is damaged, or of another model
    """
    path = out / CHECKPOINT_NAME
    if not path.exists():
        (out / METRICS_NAME).unlink(missing_ok=True)
        return False
    try:
        trainer.restore(*read_tensors(path))
    except (InputError, KeyError, TypeError, ValueError, RuntimeError):
        raise InputError(
            "is no checkpoint of this fit: damaged, or put there by something else",
            where=path,
            hint="remove it: the same command then starts from the beginning",
        ) from None
    kept = [line for line in read_history(out) if line.get("step", 0) <= trainer.progress.step]
    write_text(out / METRICS_NAME, "".join(json.dumps(line) + "\n" for line in kept))
    return True


def _glance(trainer: Trainer, data: Dataset, partition: Partition) -> tuple[str, Queries]:
    """What is looked at while training, as a copy: the other judging queries need not stay in memory."""
    looks_at, judging = judging_queries(data, partition)
    return looks_at, glance_of(trainer, judging)


def _train(trainer: Trainer, glance: Queries, out: Path, progress: ProgressCallback) -> None:
    saved = time.perf_counter()
    done = trainer.share >= 1.0
    with _finishing_steps(trainer):
        while not (done or trainer.stop):
            done = trainer.train(_REPORT_SECONDS)
            record = _record(trainer, glance)
            with (out / METRICS_NAME).open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(record) + "\n")
            progress(trainer.share, _note(record))
            if time.perf_counter() - saved > _CHECKPOINT_SECONDS or done or trainer.stop:
                write_tensors(out / CHECKPOINT_NAME, *trainer.state())
                saved = time.perf_counter()
    if trainer.stop:
        raise KeyboardInterrupt


@contextmanager
def _finishing_steps(trainer: Trainer) -> Iterator[None]:
    """Let the first Ctrl-C end training after the present step, so that a checkpoint loses nothing; the
    second one acts at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: object) -> None:
        if trainer.stop:
            raise KeyboardInterrupt
        trainer.stop = True

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def judging_queries(data: Dataset, partition: Partition) -> tuple[str, Queries]:
    """The set that tells how good a fit is, before and while it is trained, and its name among the errors.

    That of the test split, which has more paths: of gloss, four paths per query often cannot tell at all. Of
    the held-out queries where there is no such split, or one of few queries. Nothing is chosen by it.
    """
    held_out = partition.held_out_queries
    test = load_split(data, "test") if "test" in data.splits and data.shards("test") else None
    if test is not None and len(test) >= min(len(held_out), _FEWEST):
        return "test", test
    return "held_out_queries", held_out


def glance_of(trainer: Trainer, queries: Queries, most: int = _GLANCE) -> Queries:
    """So many of the judging queries at most, from all parts of them. Looking costs time, of a model of
    neighborhoods more than of the others."""
    most = max(most // trainer.model.positions, most // 16)
    return queries.take(np.arange(0, len(queries), max(1, math.ceil(len(queries) / most))))


def missed(trainer: Trainer, queries: Queries) -> Estimate:
    """Unexplained variance of queries by the model as it is now."""
    return unexplained_variance(trainer.predict(queries), queries.value_a, queries.value_b)


def _record(trainer: Trainer, glance: Queries) -> dict[str, Any]:
    state = trainer.progress
    record: dict[str, Any] = {
        "step": state.step,
        "seconds": round(state.seconds, 3),
        "share": round(trainer.share, 5),
        "loss": state.loss,
        "unexplained": None,
        "unexplained_error": None,
        "queries_per_second": round(state.step * trainer.batch / max(state.seconds, 1e-9)),
    }
    if len(glance):
        found = missed(trainer, glance).as_dict()
        record |= {"unexplained": found["value"], "unexplained_error": found["error"]}
    return record


def _note(record: dict[str, Any]) -> str:
    note = f"loss {record['loss']:.3f}"
    if record["unexplained"] is not None:
        note += f", unexplained {record['unexplained']:.3f} ± {record['unexplained_error']:.3f}"
    return f"{note}, {record['queries_per_second'] / 1e6:.2f} M queries/s"


def read_history(folder: str | Path) -> list[dict[str, Any]]:
    """The records of ``metrics.jsonl``; what follows a damaged line is left out."""
    path = Path(folder) / METRICS_NAME
    out = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []:
        try:
            record = json.loads(line)
        except (ValueError, RecursionError):
            break
        if not isinstance(record, dict):
            break
        out.append(record)
    return out


def _finished(out: Path, total: float, *, resumed: bool = True) -> FitResult:
    material = Material.load(out)
    training = material.description["training"]
    return FitResult(
        material, out, read_history(out), training["seconds"], round(total, 3), training["errors"], resumed
    )
