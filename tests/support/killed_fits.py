"""Fits that are killed and started again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import pytest

import mbtf_fit.training.fit as fits
from mbtf_fit.training.trainer import Trainer

T = TypeVar("T")


class Killed(BaseException):
    """Nothing that runs after it may tidy up: stands for SIGKILL."""


def kill_in(patch: pytest.MonkeyPatch, steps: set[int]) -> None:
    """Kill training in steps, of which the first is 1."""
    step = Trainer._step

    def dying(self: Trainer, *arguments: Any) -> Any:
        if self.progress.step + 1 in steps:
            raise Killed
        return step(self, *arguments)

    patch.setattr(Trainer, "_step", dying)


def run_killed(patch: pytest.MonkeyPatch, run: Callable[[], T]) -> tuple[T, int]:
    """What `run` returns, which is killed at random steps and started again, and how often it was. Not every
    checkpoint is saved: some steps are done again."""
    random = np.random.default_rng(0)
    step, save, left = Trainer._step, fits.write_checkpoint, 0

    def dying(self: Trainer, *arguments: Any) -> Any:
        nonlocal left
        left -= 1
        if left == 0:
            raise Killed
        return step(self, *arguments)

    def forgetful(*arguments: Any) -> None:
        if random.random() < 0.6:
            save(*arguments)

    patch.setattr(Trainer, "_step", dying)
    patch.setattr(fits, "write_checkpoint", forgetful)
    for kills in range(100):
        left = int(random.integers(2, 7))
        try:
            return run(), kills
        except Killed:
            continue
    raise AssertionError("the fit does not end")
