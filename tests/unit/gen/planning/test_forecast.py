"""Forecasts: bytes, noise, seconds; what does not fit on the disk is refused."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbtf_core.app.console import run
from mbtf_core.data.schema import Queries
from mbtf_core.files import folders
from mbtf_gen.cli.app import app
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning import forecast as module
from mbtf_gen.planning import sample_allocation
from mbtf_gen.planning.forecast import forecast
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import RunPlan, allocate, plan_effects
from mbtf_gen.planning.simulation import pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heightfield_tile import HeightFieldTile

RATE = 1e6
# Seconds that each launch takes beside its paths.
LAUNCH = 0.0


class Clock:
    """Time that passes only where paths are traced."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


class Fake:
    """Estimates of known noise, one standard deviation of 0.8 per path at a mean value of 0.25. Queries of a
    group have the same noise, and one more light takes half the time of a path of one."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def estimate(
        self, queries: Queries, spp: Any, stream: Stream, path_variance: bool = False, lights: int = 1
    ) -> Estimates:
        assert stream.split == "pilot"
        rng = np.random.default_rng([stream.shard, stream.first_pass])
        n = len(queries.sigma)
        counts = np.broadcast_to(np.asarray(spp, np.int64), (n,))
        paths = int(counts.sum()) // lights
        self.clock.now += LAUNCH + 0.5 * (1 + lights) * paths / RATE
        noise = 0.8 * np.sqrt(2.0 / counts)[:, None]
        a, b = (np.tile(rng.normal(size=(n // lights, 3)), (lights, 1)) for _ in range(2))
        a, b = ((0.25 + noise * x).astype(np.float32) for x in (a, b))
        every = None if isinstance(spp, int) else counts
        variance = np.full(n, 0.8**2, np.float32) if path_variance else None
        return Estimates(a, b, None, paths, 0, 0, 0, spp=every, path_variance=variance)


def job_of(**queries: Any) -> Job:
    heights = np.random.default_rng(0).random((16, 16))
    material = HeightFieldTile(heights, height_scale=0.1, maps={"base_color": np.array([0.5, 0.5, 0.5])})
    return Job.of(GeneratorConfig.model_validate({"material": "m", "queries": queries}), material)


@pytest.mark.parametrize("options", [{}, {"layout": "image"}, {"layout": "image", "patch_size": 12}])
def test_pilots_sample_many_directions_in_every_layout(options: dict[str, Any]) -> None:
    """An image of the image layout has one pair of directions and one footprint for all its texels."""
    queries = pilot_queries(job_of(**options), 200, 1)
    assert queries.u.shape == (200, 2)
    for array in (queries.sigma[:, None], queries.omega_i, queries.omega_o):
        assert len(np.unique(array, axis=0)) > 190


@pytest.fixture
def faked(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(sample_allocation, "build_estimator", lambda job, plan, tiles: Fake(clock))
    monkeypatch.setattr(module, "build_estimator", lambda job, plan: Fake(clock))


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_seconds_and_noise(faked: None, layout: str) -> None:
    job = job_of(train="1000000", spp=8, test="20000", test_spp=64, layout=layout)
    found = forecast(job, RunPlan(plan_effects(job, pilots=False)), seconds=0.0)
    assert found.paths == pytest.approx(1e6 * 8 + 2e4 * 64, rel=2e-2)
    assert found.seconds == pytest.approx(found.paths / RATE, rel=1e-6)
    noise = 0.8 / math.sqrt(8) / 0.25
    assert abs(found.relative_error - noise) < 5 * found.relative_error_se
    assert found.relative_error_se < 0.02 * noise
    assert "decide" not in found.describe()
    rare = replace(found, relative_error=1.28, relative_error_se=0.17).describe()
    assert "noise of one training value 128% of the mean value, ± 17% or more" in rare


def test_lights_of_one_path_take_less_time_and_their_noise_is_no_new_knowledge(faked: None) -> None:
    plan = RunPlan(plan_effects(job_of(), pilots=False))
    alone, shared = (
        forecast(job_of(train="1000000", spp=8, test="20000", test_spp=64, lights_per_path=n), plan, 0.0)
        for n in (1, 4)
    )
    assert shared.paths == pytest.approx(1e6 * 8 / 4 + 2e4 * 64, rel=1e-6)
    assert shared.seconds == pytest.approx((2.5 * 1e6 * 8 / 4 + 2e4 * 64) / RATE, rel=1e-6)
    assert shared.paths_per_query == 8
    # Pieces take equal times, so 2.5 times fewer paths of four lights, with equal noise within groups.
    assert shared.relative_error_se == pytest.approx(np.sqrt(2.5) * alone.relative_error_se, rel=0.1)
    assert abs(shared.relative_error - alone.relative_error) < 5 * shared.relative_error_se


def test_a_target_error_decides_paths_and_seconds(faked: None) -> None:
    """All queries need the paths that bring 0.8 to 8% of 0.25 or so, unless the cap is lower."""
    for cap in (8192, 512):
        job = job_of(train="1000000", test="20000", test_spp=64, target_error="8%", max_spp=cap)
        plan = allocate(job, plan_effects(job, pilots=False))
        found = forecast(job, plan, seconds=0.0)
        # 1600, rounded up to a power of two or three times one; less where a pilot's value is large.
        stored = found.paths_per_query
        assert stored == pytest.approx(min(2048, cap), rel=0.03)
        # The pilots of the queries are paths, too.
        assert found.paths == pytest.approx(1e6 * (stored + 16) + 2e4 * 64, rel=1e-3)
        assert found.seconds == pytest.approx(found.paths / RATE, rel=1e-3)
        assert found.relative_error == pytest.approx(0.8 / np.sqrt(stored) / 0.25, rel=0.1)


def test_a_test_set_alone_is_forecast_from_many_paths(faked: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Extrapolating from launches of its one training query multiplied their overhead."""
    monkeypatch.setattr(sys.modules[__name__], "LAUNCH", 0.01)
    job = job_of(train="1", spp=4, test="20000", test_spp=256)
    found = forecast(job, RunPlan(plan_effects(job, pilots=False)), seconds=0.0)
    assert found.seconds == pytest.approx(found.paths / RATE, rel=0.1)


@pytest.fixture
def heights(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((256, 256)))
    return tmp_path / "height.npy"


@pytest.mark.parametrize(
    "words",
    [(), ("reference", "--size", "512"), ("preview", "--size", "1024")],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(
    heights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    out = heights.parent / "out"
    line = [*words[:1], str(heights), *words[1:], "--height-scale", "0.01", "-o", str(out)]
    assert run(app, line) == 3
    message = capsys.readouterr().err
    assert "1.0 MB are free" in message
    assert "-o" in message.splitlines()[-1]
    assert not out.exists()
