"""Checkpoints: the state of a training loop in one file, and training resumed from it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.material.storage import read_tensors, write_tensors
from mbtf_fit.training.loop import TrainingLoop
from mbtf_fit.training.trainer import Trainer, TrainingProgress

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


def write_checkpoint(loop: TrainingLoop, path: Path) -> None:
    """Write parameters, optimizer state and progress."""
    write_tensors(path, state_tensors(loop), asdict(loop.progress))


def read_checkpoint(loop: TrainingLoop, path: Path) -> None:
    """Resume from a checkpoint of the same configuration and data, with identical results.

    Raises
    ------
    InputError : the file is no such checkpoint
    """
    try:
        tensors, progress = read_tensors(path)
        for k, trainer in enumerate(loop.trainers):
            mine = {n.removeprefix(f"{k}."): t for n, t in tensors.items() if n.startswith(f"{k}.")}
            _load(trainer, _own_parameters(loop, k), mine)
        loop.trainers[0].progress = TrainingProgress(
            int(progress["step"]), float(progress["seconds"]), float(progress["loss"])
        )
    except (InputError, KeyError, TypeError, ValueError, RuntimeError):
        raise InputError(
            "is not a checkpoint of this fit: corrupt, or of an older version",
            where=path,
            hint="remove it: the same command then starts from the beginning",
        ) from None
    loop.link()


def _load(trainer: Trainer, parameters: dict[str, Tensor], tensors: dict[str, Tensor]) -> None:
    """Set parameters, optimizer state and the model's own state of a trainer."""
    with torch.no_grad():
        for name, p in parameters.items():
            p.copy_(tensors[f"model.{name}"])
            trainer.optimizer.state[p] = {
                key: tensors[f"adam.{key}.{name}"].to(p.device)
                for key in _MOMENTS
                if f"adam.{key}.{name}" in tensors
            }
    state = {n.removeprefix("state."): t for n, t in tensors.items() if n.startswith("state.")}
    trainer.hooks.restore(state)
