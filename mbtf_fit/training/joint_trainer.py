"""Training of several materials with one network: each has textures of its own.

Steps take the materials in turn. A step trains the textures of one material, and the network, which all
materials share with the state of its optimizer: Adam's moments average the gradients of the materials.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.training.checkpoint import read_joint_checkpoint, write_joint_checkpoint
from mbtf_fit.training.loop import TrainingLoop, TrainingProgress
from mbtf_fit.training.trainer import Trainer


def shared_decay(decays: Sequence[float]) -> float:
    """Weight decay of a network that several materials share, from those of networks of their own.

    The mean, divided by the square root of their number. More materials are more queries, which need less
    decay, but the share of each in the network's weights is smaller.
    """
    return sum(decays) / len(decays) ** 1.5


class JointTrainer(TrainingLoop):
    """Training of several models that share their networks.

    Parameters
    ----------
    config : FitConfig
        Options of the fit; the budget is that of all materials together.
    trainers : dict
        Name → trainer of each material, at its first step. The models share their networks already
        (:meth:`NeuralMaterial.share_networks <mbtf_fit.pytorch.material.NeuralMaterial.share_networks>`).
    """

    def __init__(self, config: FitConfig, trainers: dict[str, Trainer]) -> None:
        self.config = config
        self.names: Sequence[str] = list(trainers)
        self.trainers: Sequence[Trainer] = list(trainers.values())
        self.device = self.trainers[0].device
        self.progress = TrainingProgress()
        self._link()
        decay = shared_decay([trainer.weight_decay.weights for trainer in self.trainers])
        for trainer in self.trainers:
            trainer.weight_decay = replace(trainer.weight_decay, weights=decay)

    def _link(self) -> None:
        """Let all trainers have the same progress, and the same state of the networks' optimizer."""
        first = self.trainers[0]
        for trainer in self.trainers:
            trainer.progress = self.progress
            for module in first.model.networks().values():
                for p in module.parameters():
                    trainer.optimizer.state[p] = first.optimizer.state[p]

    @property
    def max_threads(self) -> int:
        return min(trainer.max_threads for trainer in self.trainers)

    def batches_of(self, index: int, step: int) -> int:
        """Batches that a material has had before a step."""
        return (step - index + len(self.trainers) - 1) // len(self.trainers)

    def _steps(self, workers: Workers) -> Iterator[Tensor]:
        first = self.progress.step
        steps = [t.steps(workers, self.batches_of(k, first)) for k, t in enumerate(self.trainers)]
        while True:
            yield next(steps[self.progress.step % len(steps)])

    def _parameters(self) -> Iterator[Tensor]:
        for trainer in self.trainers:
            yield from trainer.model.parameters()

    def health(self) -> Tensor:
        # That of the last step, which includes the networks.
        return self.trainers[self.progress.step % len(self.trainers)].health()

    def _stop_at(self, step: int) -> NoReturn:
        index = step % len(self.trainers)
        try:
            self.trainers[index].stop_at(step, self.batches_of(index, step))
        except InputError as error:
            raise InputError(error.what, where=self.names[index], hint=error.hint) from None

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        write_joint_checkpoint(self.trainers, path)

    def restore(self, path: Path) -> None:
        """Resume from a checkpoint of the same configuration and data."""
        self.progress = read_joint_checkpoint(self.trainers, path)
        self._link()
