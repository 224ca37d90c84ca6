"""Checkpoints: the state of a trainer in one file, and training resumed from it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.material.format import read_tensors, write_tensors
from mbtf_fit.training.loop import TrainingProgress
from mbtf_fit.training.trainer import Trainer

CHECKPOINT_NAME = "checkpoint.safetensors"
_STATE = "state."
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def state_tensors(trainer: Trainer) -> dict[str, Tensor]:
    """Parameters, optimizer state and state of the model by name."""
    parameters = _parameters(trainer)
    tensors = {f"model.{name}": p.detach() for name, p in parameters.items()}
    for name, p in parameters.items():
        for key, value in trainer.optimizer.state.get(p, {}).items():
            tensors[f"adam.{key}.{name}"] = value
    return tensors | {f"{_STATE}{name}": t for name, t in trainer.hooks.state().items()}


def _parameters(trainer: Trainer) -> dict[str, Tensor]:
    return {**dict(trainer.model.named_parameters()), **trainer.hooks.parameters()}


def write_checkpoint(trainer: Trainer, path: Path) -> None:
    """Write parameters, optimizer state and progress."""
    write_tensors(path, state_tensors(trainer), asdict(trainer.progress))


def write_joint_checkpoint(trainers: Sequence[Trainer], path: Path) -> None:
    """Write those of trainers that share networks and progress."""
    tensors: dict[str, Tensor] = {}
    for k, trainer in enumerate(trainers):
        networks = () if k == 0 else tuple(trainer.model.networks())
        tensors |= {
            f"{k}.{name}": tensor
            for name, tensor in state_tensors(trainer).items()
            if not _is_of(name, networks)
        }
    write_tensors(path, tensors, asdict(trainers[0].progress))


def _is_of(name: str, networks: Sequence[str]) -> bool:
    """Whether a tensor of :func:`state_tensors` is of one of these networks."""
    return any(f".{network}." in name for network in networks)


def read_checkpoint(trainer: Trainer, path: Path) -> None:
    """Resume from a checkpoint of the same configuration and data, with identical results."""
    with _refused(path):
        tensors, progress = read_tensors(path)
        _load(trainer, tensors)
        trainer.progress = _progress(progress)


def read_joint_checkpoint(trainers: Sequence[Trainer], path: Path) -> TrainingProgress:
    """Load a checkpoint of trainers that share networks; returns their progress."""
    with _refused(path):
        tensors, progress = read_tensors(path)
        for k, trainer in enumerate(trainers):
            own = {name.partition(".")[2]: t for name, t in tensors.items() if name.startswith(f"{k}.")}
            shared = tuple(trainer.model.networks())
            networks = {n.partition(".")[2]: t for n, t in tensors.items() if _is_of(n, shared)}
            _load(trainer, {**networks, **own})
        return _progress(progress)


def _load(trainer: Trainer, tensors: Mapping[str, Tensor]) -> None:
    """Set parameters, optimizer state and the model's own state of a trainer."""
    with torch.no_grad():
        for name, p in _parameters(trainer).items():
            p.copy_(tensors[f"model.{name}"])
            trainer.optimizer.state[p] = {
                key: tensors[f"adam.{key}.{name}"].to(p.device)
                for key in _MOMENTS
                if f"adam.{key}.{name}" in tensors
            }
    trainer.hooks.restore({k.removeprefix(_STATE): t for k, t in tensors.items() if k.startswith(_STATE)})


def _progress(data: Mapping[str, Any]) -> TrainingProgress:
    return TrainingProgress(int(data["step"]), float(data["seconds"]), float(data["loss"]))


@contextlib.contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Errors of a block that reads a checkpoint, in words."""
    try:
        yield
    except (InputError, KeyError, TypeError, ValueError, RuntimeError):
        raise InputError(
            "is not a checkpoint of this fit: corrupt, or of an older version",
            where=path,
            hint="remove it: the same command then starts from the beginning",
        ) from None
