"""A generator benchmark whose estimator has known bias and noise."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbtf_core.data.schema import Queries
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.run import Job
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_pipeline.cost.generator import GeneratorBenchmark

NOISE = 0.8  # standard deviation of one path, relative to the value
SHIFT = 0.25  # bias of one interaction, relative to the value


class FakeEstimator:
    """Values of known bias and noise, between 0.2 and 0.3 along u; random numbers depend on the stream alone,
    as the real ones."""

    scale, slope, noise = 1.0, 0.1, NOISE

    def __init__(self, job: Job) -> None:
        self.shift = SHIFT if job.config.transport.max_depth == 1 else 0.0

    def estimate(
        self, queries: Queries, spp: Any, stream: Stream, *, path_variance: bool = False, lights: int = 1
    ) -> Estimates:
        # A biased configuration traces other paths.
        key = [stream.root, stream.shard, stream.first_pass, len(queries.sigma), self.shift > 0]
        rng = np.random.default_rng(key)
        each = np.broadcast_to(spp, len(queries.sigma))
        truth = self.scale * (0.25 + self.slope * (queries.u[:, :1] - 0.5))
        # The bias has both signs: its square is measured, query by query.
        sign = np.where(queries.u[:, 1:] < 0.5, -1.0, 1.0)
        halves = [
            truth * (1 + self.shift * sign)
            + 0.25 * self.scale * self.noise * rng.normal(size=(len(truth), 3)) / np.sqrt(each[:, None] / 2)
            for _ in range(2)
        ]
        a, b = (h.astype(np.float32) for h in halves)
        known = np.full(len(truth), (0.25 * NOISE) ** 2, np.float32) if path_variance else None
        return Estimates(a, b, None, int(each.sum()), 0, 0, 0, path_variance=known)


def fake_benchmark(monkeypatch: pytest.MonkeyPatch) -> GeneratorBenchmark:
    """A small height field, traced by :class:`FakeEstimator` until the test ends."""
    module = "mbtf_pipeline.cost.generator"
    plan = SimpleNamespace(effects=SimpleNamespace(closed_form=False), allocation=None)
    monkeypatch.setattr(f"{module}.build_estimator", lambda job, plan: FakeEstimator(job))
    monkeypatch.setattr(f"{module}.plan_effects", lambda job: plan.effects)
    monkeypatch.setattr(f"{module}.allocate", lambda job, effects: plan)
    heights = np.random.default_rng(0).random((128, 128))
    material = HeightFieldTile(heights, height_scale=0.1, maps={"base_color": np.array([0.5, 0.5, 0.5])})
    return GeneratorBenchmark(GeneratorConfig(material="heights.npy"), material)
