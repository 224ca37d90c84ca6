"""Checkpoints: the state of a trainer in one file, and training resumed from it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from mbtf_core.errors import InputError
from mbtf_fit.material.storage import read_tensors, write_tensors
from mbtf_fit.models.learned_relief import LearnedRelief
from mbtf_fit.training.trainer import Progress, Trainer

CHECKPOINT_NAME = "checkpoint.safetensors"
_SURFACE = "surface."
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def state_tensors(trainer: Trainer) -> dict[str, Tensor]:
    """Parameters, optimizer state and traced surface by name."""
    tensors = {f"model.{name}": p.detach() for name, p in trainer.model.named_parameters()}
    for name, p in trainer.model.named_parameters():
        for key, value in trainer.optimizer.state.get(p, {}).items():
            tensors[f"adam.{key}.{name}"] = value
    if isinstance(trainer.model, LearnedRelief):
        tensors |= {f"{_SURFACE}{name}": t for name, t in trainer.model.surface_state().items()}
    return tensors


def write_checkpoint(trainer: Trainer, path: Path) -> None:
    """Write parameters, optimizer state and progress."""
    write_tensors(path, state_tensors(trainer), asdict(trainer.progress))


def read_checkpoint(trainer: Trainer, path: Path) -> None:
    """Resume from a checkpoint of the same configuration and data, with identical results."""
    try:
        tensors, progress = read_tensors(path)
        with torch.no_grad():
            for name, p in trainer.model.named_parameters():
                p.copy_(tensors[f"model.{name}"])
                trainer.optimizer.state[p] = {
                    key: tensors[f"adam.{key}.{name}"].to(p.device)
                    for key in _MOMENTS
                    if f"adam.{key}.{name}" in tensors
                }
        if isinstance(trainer.model, LearnedRelief):
            surface = {k.removeprefix(_SURFACE): t for k, t in tensors.items() if k.startswith(_SURFACE)}
            trainer.model.restore_surface(surface)
        step, seconds, loss = (progress[key] for key in ("step", "seconds", "loss"))
        trainer.progress = Progress(int(step), float(seconds), float(loss))
    except (InputError, KeyError, TypeError, ValueError, RuntimeError):
        raise InputError(
            "is not a checkpoint of this fit: corrupt, or of an older version",
            where=path,
            hint="remove it: the same command then starts from the beginning",
        ) from None
