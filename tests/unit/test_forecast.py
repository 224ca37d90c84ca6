"""Forecasts: bytes as written, noise as it is, seconds in proportion to the paths."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.datasets import write_dataset

from mbtf_gen import forecast as module
from mbtf_gen.config import GeneratorConfig
from mbtf_gen.dataset import Dataset
from mbtf_gen.estimates import Estimates, Stream
from mbtf_gen.forecast import forecast, row_bytes, size_text
from mbtf_gen.generation import Job
from mbtf_gen.material import Material
from mbtf_gen.planning import plan_effects
from mbtf_gen.queries import Queries

RATE = 1e6


class Clock:
    """Time that passes only where paths are traced."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Fake:
    """Estimates of known noise, one standard deviation of 0.8 per path at a mean value of 0.25."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def estimate(self, queries: Queries, spp: int, stream: Stream) -> Estimates:
        assert stream.split == "pilot"
        rng = np.random.default_rng([stream.shard, spp])
        n = len(queries.sigma)
        self.clock.now += n * spp / RATE
        noise = 0.8 * math.sqrt(2.0 / spp)
        a, b = ((0.25 + noise * rng.normal(size=(n, 3))).astype(np.float32) for _ in range(2))
        return Estimates(a, b, None, n * spp, 0, 0, 0)


def job_of(**queries: Any) -> Job:
    heights = np.random.default_rng(0).random((16, 16))
    material = Material(heights, height_scale=0.1, height_bits=None, basecolor=np.array([0.5, 0.5, 0.5]))
    return Job.of(GeneratorConfig.model_validate({"material": "m", "queries": queries}), material)


@pytest.fixture
def faked(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(Job, "estimator", lambda self, plan: Fake(clock))


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_seconds_and_noise(faked: None, layout: str) -> None:
    job = job_of(train="1000000", spp=8, test="20000", test_spp=64, layout=layout)
    found = forecast(job, plan_effects(job, pilots=False), seconds=0.0)
    assert found.paths_per_second == pytest.approx(RATE)
    assert found.paths == pytest.approx(1e6 * 8 + 2e4 * 64, rel=2e-2)
    assert found.seconds == pytest.approx(found.paths / RATE, rel=1e-6)
    noise = 0.8 / math.sqrt(8) / 0.25
    assert abs(found.relative_error - noise) < 5 * found.relative_error_se
    assert found.relative_error_se < 0.02 * noise


def test_bytes_are_those_of_the_arrays(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "shards", queries={"train": "64", "test": "16", "spp": 4})
    arrays = Dataset.open(data.folder).load("train")
    assert row_bytes(False) * 64 == sum(a.nbytes for a in arrays.values())
    assert row_bytes(True) == row_bytes(False) + 4


def test_a_run_without_noise_is_forecast_too(faked: None) -> None:
    job = job_of(train="1000", test="10")
    quiet = forecast(job, plan_effects(job, pilots=False), seconds=0.0)
    assert quiet.bytes == 1010 * row_bytes(False)
    assert str(size_text(quiet.bytes)) == "65 kB"
    assert "of the mean value" in quiet.describe()


@pytest.mark.parametrize(("size", "text"), [(812e3, "812 kB"), (6.4e7, "64 MB"), (1.68e9, "1.7 GB")])
def test_sizes_read_well(size: float, text: str) -> None:
    assert size_text(size) == text
