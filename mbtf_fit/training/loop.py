"""The training loop: steps of one or several materials until a budget is spent, all numbers finite.

Steps take the materials in turn. A step trains the textures of one material, and the network, which all
materials share with the state of its optimizer: Adam's moments average the gradients of the materials. A
checkpoint is the state of a loop in one file.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from threading import Event
from typing import Any, NoReturn

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.errors import EngineError, InputError
from mbtf_core.run.task import worker_threads
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.material.format import read_tensors, write_tensors
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.training.best_state import BestState, excess_error, is_candidate, overfits
from mbtf_fit.training.trainer import Trainer, TrainingProgress

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3


def choose_device(name: str) -> torch.device:
    """The device to train on; ``auto`` is CUDA if available. A worker trains with its threads."""
    if (threads := worker_threads()) is not None:
        torch.set_num_threads(threads)
    available = torch.cuda.is_available()
    if name == "cuda" and not available:
        raise EngineError(
            "no CUDA device is available", where="--device cuda", hint="use --device cpu or auto"
        )
    return torch.device("cuda" if available and name != "cpu" else "cpu")


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks of up to 32 MiB instead of returning them to the kernel.

    A training step frees and allocates the same few megabytes; page faults would cost as much as the
    arithmetic.
    """
    if sys.platform != "linux":
        return
    with contextlib.suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_M_MMAP_THRESHOLD, 1 << 25)
        library.mallopt(_M_TRIM_THRESHOLD, 1 << 30)


def shared_decay(decays: Sequence[float]) -> float:
    """Weight decay of a network that several materials share, from those of networks of their own.

    The mean, divided by the square root of their number. More materials are more queries, which need less
    decay, but the share of each in the network's weights is smaller.
    """
    return sum(decays) / len(decays) ** 1.5


class TrainingLoop:
    """Training of one model, or of several that share their networks.

    Parameters
    ----------
    trainers : sequence of Trainer
        Of each material, at the same step. The models share their networks already
        (:meth:`NeuralMaterial.share_networks <mbtf_fit.pytorch.material.NeuralMaterial.share_networks>`).
    names : sequence of str
        Names of the materials, for messages.

    Attributes
    ----------
    progress : steps done, of all materials together
    best : state of the smallest validation error so far
    validated : step of the last validation, and its predictions
    """

    def __init__(self, trainers: Sequence[Trainer], names: Sequence[str] = ("",)) -> None:
        self.trainers, self.names = trainers, names
        self.best: BestState | None = None
        self.validated: tuple[int, Sequence[NDArray[np.float32]]] = (-1, [])
        found = [trainer.regularization for trainer in trainers]
        decay = {
            name: shared_decay([getattr(one, name) for one in found])
            for name in ("spatial_weights", "weights")
        }
        for trainer in trainers:
            trainer.regularization = replace(trainer.regularization, **decay)
        self.link()

    def link(self) -> None:
        """Let all trainers have the progress of the first one, and its state of the networks' optimizer."""
        first, *others = self.trainers
        self.progress = first.progress
        for trainer in others:
            trainer.progress = self.progress
            for module in first.model.networks().values():
                for p in module.parameters():
                    trainer.optimizer.state[p] = first.optimizer.state[p]

    @property
    def fraction(self) -> float:
        """Fraction of the budget that is spent, in [0, 1]."""
        return self.trainers[0].fraction

    def batches_of(self, index: int, step: int) -> int:
        """Batches that a material has had before a step."""
        return (step - index + len(self.trainers) - 1) // len(self.trainers)

    def validate(self, predictions: Sequence[NDArray[np.float32]], subsets: Sequence[ShardQueries]) -> None:
        """Remember the current state if it is a candidate and none before had smaller errors; `predictions`:
        of `subsets`, the validation queries of each material."""
        self.validated = self.progress.step, predictions
        if not is_candidate(self.progress.step):
            return
        if self.best is None or excess_error(predictions, self.best.predictions, subsets).value <= 0:
            self.best = BestState(weights_of(self), replace(self.progress), list(predictions))

    def keep_best(self, subsets: Sequence[ShardQueries]) -> Sequence[NDArray[np.float32]]:
        """Return to the best state, if its errors are significantly smaller than the current ones; returns
        the predictions of the state that is kept."""
        step, predictions = self.validated
        if step != self.progress.step:
            predictions = [t.predict(queries) for t, queries in zip(self.trainers, subsets, strict=True)]
        if self.best is None or self.best.progress.step == self.progress.step:
            return predictions
        if not overfits(predictions, self.best.predictions, subsets):
            return predictions
        load_weights(self, self.best.tensors, self.best.progress)
        return self.best.predictions

    def _steps(self, workers: Workers) -> Iterator[Tensor]:
        """Endless steps from the current one on; each yields its mean loss."""
        first = self.progress.step
        steps = [t.steps(workers, self.batches_of(k, first)) for k, t in enumerate(self.trainers)]
        while True:
            yield next(steps[self.progress.step % len(steps)])

    def _is_finite(self) -> bool:
        return all(bool(p.isfinite().all()) for t in self.trainers for p in t.parameters().values())

    def train(self, seconds: float, stop: Event | None = None, *, pause: bool = False) -> bool:
        """Train for about so long, or until the budget is spent; returns whether it is. Once `stop` is set,
        training ends after the current step, and with `pause` at a candidate for the state to keep."""
        until = time.perf_counter() + seconds
        first = self.progress.step
        losses: list[Tensor] = []
        health: list[Tensor] = []
        limit = min(trainer.max_threads for trainer in self.trainers)
        with Workers(self.trainers[0].device, limit=limit) as workers:
            steps = self._steps(workers)
            while self.fraction < 1.0 and not (stop is not None and stop.is_set() and losses):
                start = time.perf_counter()
                if losses and (start >= until or (pause and is_candidate(self.progress.step))):
                    break
                try:
                    losses.append(next(steps))
                except (RuntimeError, IndexError):
                    # A lookup at NaN has no texel and fails before the loss could show it.
                    if self._is_finite():
                        raise
                    self._stop_diverged(first, losses, health)
                health.append(self.trainers[self.progress.step % len(self.trainers)].health())
                self.progress.step += 1
                self.progress.seconds += time.perf_counter() - start
        if losses:
            start = time.perf_counter()
            # A GPU may still work on the last steps: reading the loss waits for them.
            self.progress.loss = float(torch.stack(losses).mean())
            self.progress.seconds += time.perf_counter() - start
            if not math.isfinite(self.progress.loss + float(torch.stack(health).sum())):
                self._stop_diverged(first, losses, health)
        return self.fraction >= 1.0

    def _stop_diverged(self, first: int, losses: list[Tensor], health: list[Tensor]) -> NoReturn:
        """Report the first bad step of those since `first`."""
        finite = [math.isfinite(float(a) + float(b)) for a, b in zip(losses, health, strict=False)]
        step = first + [*finite, False].index(False)
        lower = self.trainers[0].config.training.learning_rate / 3
        raise InputError(
            f"training diverged at step {step + 1}: its batch gave numbers that are not finite",
            where=self.names[step % len(self.trainers)],
            hint=f"lower the learning rate: --learning-rate {lower:.1g} --overwrite",
        ) from None


CHECKPOINT_NAME = "checkpoint.safetensors"
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def _own_parameters(loop: TrainingLoop, number: int) -> dict[str, Tensor]:
    """Parameters of a trainer by name; the first one has those of the networks."""
    trainer = loop.trainers[number]
    shared = tuple(f"{name}." for name in trainer.model.networks()) if number else ()
    return {name: p for name, p in trainer.parameters().items() if not name.startswith(shared)}


def state_tensors(loop: TrainingLoop) -> dict[str, Tensor]:
    """Parameters, optimizer state and state of the model by number of the trainer and name."""
    tensors: dict[str, Tensor] = {}
    for k, trainer in enumerate(loop.trainers):
        for name, p in _own_parameters(loop, k).items():
            tensors[f"{k}.model.{name}"] = p.detach()
            for key, value in trainer.optimizer.state.get(p, {}).items():
                tensors[f"{k}.adam.{key}.{name}"] = value
        tensors |= {f"{k}.state.{name}": tensor for name, tensor in trainer.hooks.state().items()}
    return tensors


def weights_of(loop: TrainingLoop) -> dict[str, Tensor]:
    """Copies of the loop's state without that of its optimizers, which :func:`load_weights` takes."""
    tensors = state_tensors(loop).items()
    return {name: tensor.detach().clone() for name, tensor in tensors if ".adam." not in name}


def load_weights(loop: TrainingLoop, tensors: dict[str, Tensor], progress: TrainingProgress) -> None:
    """Set parameters and progress to those of :func:`weights_of`, at the end of training."""
    for k, trainer in enumerate(loop.trainers):
        mine = {n.removeprefix(f"{k}."): t for n, t in tensors.items() if n.startswith(f"{k}.")}
        _load(trainer, _own_parameters(loop, k), mine)
    loop.trainers[0].progress = progress
    loop.link()


def write_checkpoint(loop: TrainingLoop, path: Path) -> None:
    """Write parameters, optimizer state, progress, and the best state."""
    tensors, data = state_tensors(loop), asdict(loop.progress)
    if loop.best is not None:
        tensors |= {f"best.{name}": tensor for name, tensor in loop.best.tensors.items()}
        tensors |= {f"predictions.{k}": torch.from_numpy(p) for k, p in enumerate(loop.best.predictions)}
        data["best"] = asdict(loop.best.progress)
    write_tensors(path, tensors, data)


def read_checkpoint(loop: TrainingLoop, path: Path) -> None:
    """Resume from a checkpoint of the same configuration and data, with identical results.

    Raises
    ------
    InputError : the file is no such checkpoint
    """
    try:
        tensors, found = read_tensors(path)
        for k, trainer in enumerate(loop.trainers):
            for name, p in _own_parameters(loop, k).items():
                trainer.optimizer.state[p] = {
                    key: tensors[stored].to(p.device, copy=True)
                    for key in _MOMENTS
                    if (stored := f"{k}.adam.{key}.{name}") in tensors
                }
        load_weights(loop, tensors, _progress(found))
        if (best := found.get("best")) is not None:
            weights = {n.removeprefix("best."): t for n, t in tensors.items() if n.startswith("best.")}
            predictions = [tensors[f"predictions.{k}"].numpy() for k in range(len(loop.trainers))]
            loop.best = BestState(weights, _progress(best), predictions)
    except (InputError, KeyError, TypeError, ValueError, RuntimeError):
        raise InputError(
            "is not a checkpoint of this fit: corrupt, or of an older version",
            where=path,
            hint="remove it: the same command then starts from the beginning",
        ) from None


def _progress(found: dict[str, Any]) -> TrainingProgress:
    return TrainingProgress(int(found["step"]), float(found["seconds"]), float(found["loss"]))


def _load(trainer: Trainer, parameters: dict[str, Tensor], tensors: dict[str, Tensor]) -> None:
    """Set parameters and the model's own state of a trainer."""
    with torch.no_grad():
        for name, p in parameters.items():
            p.copy_(tensors[f"model.{name}"])
    state = {n.removeprefix("state."): t for n, t in tensors.items() if n.startswith("state.")}
    trainer.hooks.restore(state)
