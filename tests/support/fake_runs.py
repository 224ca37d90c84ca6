"""Runs of a cost study whose true errors and seed variance are known, and which take no time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mbtf_core.stats import Estimate
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_pipeline.cost.measurement import Conditions, Configuration, Measurement
from mbtf_pipeline.cost.runs import Run

# Unexplained variance, its relative deviation over seeds, and that of the test set.
TRUE = 0.05
SEEDS, TEST = 0.1, 0.02


def run(queries: int = 1000, name: str = "a run", seconds: float = 5.0) -> Run:
    fit = {"model": "neumip", "training.time": f"{seconds:g}s", "name": name}
    return Run("run", "neumip", name, queries, 4, fit)


def conditions(folder: Path = Path(), **options: Any) -> Conditions:
    config = GeneratorConfig.model_validate({"material": "m", **options})
    command = f"mbtf-gen m --config {folder / 'generate.yaml'}"
    return Conditions(config.model_dump_json(), "basis", folder, 3.0, command)


class FakeRuns:
    """Stands for :meth:`mbtf_pipeline.cost.runs.Run.measure`: errors of normal seed deviation around the
    truth, all shifted by the error of the test set."""

    def __init__(self, seeds: float = SEEDS, test: float = TEST, study_seed: int = 0) -> None:
        self.random = np.random.default_rng(study_seed)
        self.seeds, self.test = seeds, test
        self.shift = 1 + test * self.random.normal()
        self.measured: list[Run] = []

    def measure(self, run: Run, conditions: Conditions | None = None) -> Measurement:
        self.measured.append(run)
        error = TRUE * self.shift * (1 + self.seeds * self.random.normal())
        seconds = run.planned_seconds(0.0)
        details = {"run_seconds": seconds + 1.0, "seed": float(run.seed), "queries": 1e6, "spp": 4.0}
        details |= {"training_seconds": seconds, "training_steps": 1000 * seconds}
        return Measurement(
            run.study,
            run.series,
            run.name,
            f"command of {run.label}",
            Estimate(seconds, 0.0, 1),
            Estimate(error, self.test * error, 1000),
            details=details,
        )


class MemoryStore:
    """Stands for :class:`mbtf_pipeline.cost.measurement.MeasurementFolder`."""

    def __init__(self) -> None:
        self.found: dict[str, Measurement] = {}

    def get(self, of: Configuration) -> Measurement | None:
        return self.found.get(f"{of.study} {of.key}")

    def put(self, of: Configuration, found: Measurement) -> None:
        self.found[f"{of.study} {of.key}"] = found
