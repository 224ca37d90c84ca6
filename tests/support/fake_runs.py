"""Runs of a cost study whose true errors and seed variance are known, and which take no time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.measurements import Measurement
from mbtf_pipeline.cost.runs import DataRequest, Run

# Unexplained variance, its relative deviation over seeds, and that of the test set.
TRUE = 0.05
SEEDS, TEST = 0.1, 0.02


def run(queries: int = 1000, name: str = "a run", seconds: float = 5.0) -> Run:
    fit: dict[str, Any] = {"model": "neumip", "training": {"time": seconds}, "name": name}
    return Run("whole", "neumip", name, DataRequest(queries, 4), fit)


class FakeRunner:
    """Stands for :class:`mbtf_pipeline.cost.runs.RunRunner`: errors of normal seed deviation around the
    truth, those of each seed shifted by the error of its test set."""

    def __init__(self, seeds: float = SEEDS, test: float = TEST, study_seed: int = 0) -> None:
        self.random = np.random.default_rng(study_seed)
        self.seeds, self.test = seeds, test
        self.shifts = 1 + test * self.random.normal(size=20)
        self.measured: list[Run] = []
        # Names of runs that fail.
        self.failing: set[str] = set()

    def measure(self, run: Run) -> Measurement:
        self.measured.append(run)
        if run.name in self.failing:
            raise InputError("training diverged at step 7")
        error = TRUE * self.shifts[run.data.seed] * (1 + self.seeds * self.random.normal())
        seconds = run.fit["training"]["time"]
        total = seconds + run.data.queries * 1e-6
        return Measurement(
            run.study,
            run.series,
            run.name,
            self.command_of(run),
            Estimate(seconds, 0.0, 1),
            Estimate(error, self.test * error, 1000),
            details={"total_seconds": total, "seed": float(run.data.seed)},
        )

    def measure_all(self, runs: Iterable[tuple[int, Run]]) -> Iterator[tuple[int, Run, Measurement | str]]:
        for number, run in runs:
            try:
                yield number, run, self.measure(run)
            except InputError as error:
                yield number, run, error.what

    def work_left(self, seconds: float) -> float:
        return seconds

    def expected_seconds(self, run: Run) -> float:
        return float(run.fit["training"]["time"])

    def command_of(self, run: Run) -> str:
        return f"command of {run.label}"

    def clear(self) -> None:
        """Nothing is stored."""


class MemoryStore:
    """Stands for :class:`mbtf_pipeline.cost.measurements.MeasurementFolder`."""

    def __init__(self) -> None:
        self.found: dict[str, Measurement] = {}

    def get(self, task: Run, command: str = "") -> Measurement | None:
        return self.found.get(f"{task.study} {task.key}")

    def put(self, task: Run, found: Measurement) -> None:
        self.found[f"{task.study} {task.key}"] = found
