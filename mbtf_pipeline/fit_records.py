"""Training history of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class TrainingHistory:
    """Loss and error over training time.

    Attributes
    ----------
    steps, batch : number of steps, and queries per step
    seconds : of training
    device : PyTorch device
    threads : of the CPU
    records : one per validation, from ``mbtf_fit.read_history``
    """

    steps: int
    batch: int
    seconds: float
    device: str
    threads: int
    records: list[dict[str, Any]]

    @property
    def samples(self) -> int:
        """Number of training queries, counting repetitions."""
        return self.steps * self.batch

    @property
    def samples_per_second(self) -> float:
        """Mean rate during training."""
        return self.samples / max(self.seconds, 1e-9)

    @property
    def loss(self) -> list[tuple[float, float]]:
        """(seconds, training loss including noise)."""
        return [(r["seconds"], r["loss"]) for r in self.records if _finite(r["loss"])]

    @property
    def unexplained(self) -> list[tuple[float, float, float]]:
        """(seconds, unexplained variance of the validation queries, its standard error)."""
        return [
            (r["seconds"], r["unexplained"], r["unexplained_error"])
            for r in self.records
            if _finite(r.get("unexplained")) and _finite(r.get("unexplained_error"))
        ]


def _finite(x: float | None) -> bool:
    return x is not None and math.isfinite(x)


def read_training(folder: Path) -> TrainingHistory:
    """TrainingHistory of the fit in a folder.

    Raises
    ------
    InputError : the folder contains no material
    """
    from mbtf_fit import Material, read_history

    training = Material.load(folder).description["training"]
    return TrainingHistory(
        training["steps"],
        training["batch"],
        training["seconds"],
        training["device"],
        training["threads"],
        read_history(folder),
    )
