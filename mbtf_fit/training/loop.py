"""The training loop: steps until a budget is spent, with a check that all numbers are finite."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from threading import Event
from typing import NoReturn

import torch
from torch import Tensor

from mbtf_fit.config import FitConfig
from mbtf_fit.objective.parallel import Workers


@dataclass
class TrainingProgress:
    """Progress of training: steps done, seconds spent in them over all runs, mean loss of the last steps."""

    step: int = 0
    seconds: float = 0.0
    loss: float = math.nan


class TrainingLoop(ABC):
    """Steps of an optimizer within a budget of steps or of time.

    Attributes
    ----------
    config : options of the fit; its budget is that of the loop
    device : of the parameters
    progress : steps done
    """

    config: FitConfig
    device: torch.device
    progress: TrainingProgress

    @property
    def fraction(self) -> float:
        """Fraction of the budget that is spent, in [0, 1]."""
        training = self.config.training
        if training.steps is not None:
            return min(1.0, self.progress.step / training.steps)
        return min(1.0, self.progress.seconds / training.time)

    @property
    @abstractmethod
    def max_threads(self) -> int:
        """Most threads that share a batch."""

    @abstractmethod
    def _steps(self, workers: Workers) -> Iterator[Tensor]:
        """Endless steps from the current one on; each yields its mean loss."""

    @abstractmethod
    def _parameters(self) -> Iterator[Tensor]:
        """Parameters that must stay finite."""

    @abstractmethod
    def health(self) -> Tensor:
        """A number that is finite if all network weights are."""

    @abstractmethod
    def _stop_at(self, step: int) -> NoReturn:
        """Report that training diverged at a step."""

    def train(self, seconds: float, stop: Event | None = None) -> bool:
        """Train for about so long, or until the budget is spent; returns whether it is. Once `stop` is set,
        training ends after the current step."""
        until = time.perf_counter() + seconds
        first = self.progress.step
        losses: list[Tensor] = []
        health: list[Tensor] = []
        with Workers(self.device, limit=self.max_threads) as workers:
            steps = self._steps(workers)
            while self.fraction < 1.0 and not (stop is not None and stop.is_set() and losses):
                start = time.perf_counter()
                if start >= until and losses:
                    break
                try:
                    losses.append(next(steps))
                except (RuntimeError, IndexError):
                    # A lookup at NaN has no texel and fails before the loss could show it.
                    if all(bool(p.isfinite().all()) for p in self._parameters()):
                        raise
                    self._stop_diverged(first, losses, health)
                health.append(self.health())
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
        self._stop_at(first + [*finite, False].index(False))


def health_of(weights: list[torch.nn.Parameter], device: torch.device) -> Tensor:
    """A number that is finite if all weights are."""
    with torch.no_grad():
        return torch.stack([torch.zeros((), device=device), *(p.sum() for p in weights)]).sum()
