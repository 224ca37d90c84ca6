"""The effects plan determines the traced paths and the contents of shards; resumed runs keep it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.formula_runs import Formula
from support.jobs import height_field, job_of

from mbtf_core.data.schema import Queries
from mbtf_core.files.atomic import write_checksummed
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.generation import run as generation
from mbtf_gen.generation.run import generate
from mbtf_gen.planning.effects_plan import EffectsPlan, without
from mbtf_gen.planning.run_plan import plan_effects
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Stream

load_mitsuba()

from mbtf_gen.render.estimator import Estimator  # noqa: E402

STREAM = Stream(1, "test", 0)


def noise(rows: int, columns: int) -> NDArray[np.float64]:
    h = np.random.default_rng(6).random((rows, columns))
    return (h - h.min()) / np.ptp(h)


OPACITY = np.where(np.random.default_rng(2).random((8, 8)) < 0.4, 0.2, 1.0)


@pytest.mark.parametrize(
    "mode", ["all", "all,-interreflection,-bsdf_sampling", "none,+opacity", "all,-opacity,-shadowing"]
)
def test_values_do_not_depend_on_launches_whatever_is_simulated(mode: str) -> None:
    job = job_of(height_field(noise(16, 16), 0.05, opacity=OPACITY), mode)
    estimator = build_estimator(job, plan_effects(job))
    q = pilot_queries(job, 500)
    whole = estimator.estimate(q, 8, STREAM)
    small = Estimator(estimator.tile, estimator.light, estimator.transport, launch=8 * 77)
    for queries in (q, Queries(q.u[:100], q.sigma[:100], q.omega_i[:100], q.omega_o[:100])):
        part = small.estimate(queries, 8, STREAM)
        n = len(queries.sigma)
        np.testing.assert_array_equal(part.value_a, whole.value_a[:n])
        np.testing.assert_array_equal(part.value_b, whole.value_b[:n])
        assert (part.transmittance is None) == ("-opacity" in mode)
        if part.transmittance is not None and whole.transmittance is not None:
            np.testing.assert_array_equal(part.transmittance, whole.transmittance[:n])
            assert len(np.unique(part.transmittance)) > 2


def test_the_closed_form_is_the_color_over_pi() -> None:
    color = np.array([0.8, 0.3, 0.1])
    job = job_of(height_field(np.zeros((4, 4)), 1.0, color), light={"width": 0.0})
    plan = plan_effects(job)
    assert plan.closed_form
    q = pilot_queries(job, 50)
    found = build_estimator(job, plan).estimate(q, 4, STREAM)
    for half in (found.value_a, found.value_b):
        np.testing.assert_allclose(half, np.tile(color / np.pi, (len(q.sigma), 1)), rtol=1e-6)
    # The same as traced.
    traced = build_estimator(job, replace(plan, closed_form=False)).estimate(q, 4, STREAM)
    np.testing.assert_allclose(traced.value_a, found.value_a, rtol=1e-5)


def test_resumed_and_sliced_runs_follow_the_plan_of_the_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan of the manifest applies, even where another machine would choose another one."""
    np.save(tmp_path / "height.npy", noise(4, 8))
    queries = {"train": "100", "test": "30", "spp": 2, "test_spp": 4}
    rest = {"queries": queries, "output": {"shard_queries": 40}, "effects": {"mode": "all"}}
    config = GeneratorConfig.model_validate({"material": str(tmp_path / "height.npy"), **rest})
    plans: list[EffectsPlan] = []
    monkeypatch.setattr(generation, "build_estimator", lambda job, plan: plans.append(plan) or Formula())
    out = tmp_path / "out"
    generate(config, out, slice_index=1, slice_count=2)
    manifest = json.loads((out / "manifest.json").read_text())
    stored = replace(plans[-1], max_depth=7, roulette_depth=5)
    manifest["effects"] = stored.to_manifest()
    write_checksummed(out / "manifest.json", manifest)
    monkeypatch.setattr(generation, "plan_run", None)
    generate(config, out, slice_index=2, slice_count=2)
    assert plans[-1] == stored
    assert json.loads((out / "manifest.json").read_text())["effects"] == stored.to_manifest()


def test_what_passed_is_the_view_rays_alone() -> None:
    """Scattered rays that leave through holes do not count as transmittance."""
    job = job_of(height_field(noise(16, 16), 0.15, (0.9, 0.9, 0.9), opacity=OPACITY), "all,-bsdf_sampling")
    plan = plan_effects(job)
    q = pilot_queries(job, 2000)
    full, direct = (
        build_estimator(job, p).estimate(q, 16, STREAM).transmittance
        for p in (plan, without(plan, "interreflection"))
    )
    np.testing.assert_array_equal(full, direct)


@pytest.mark.parametrize("depth", [2, 3])
def test_a_cap_is_the_same_with_and_without_sampling_of_the_surface(depth: int) -> None:
    """BSDF samples cannot hit a delta light, so only the cap affects the values."""
    stuff = height_field(noise(16, 16), 0.3, (0.9, 0.9, 0.9))
    options: dict[str, Any] = {"light": {"width": 0.0}, "queries": {"min_cos": 0.4}}
    means = []
    for mode, limit in (("all", depth), ("all,-bsdf_sampling", depth), ("all,-bsdf_sampling", depth - 1)):
        job = job_of(stuff, mode, transport={"max_depth": limit, "roulette_depth": 100}, **options)
        found = build_estimator(job, plan_effects(job)).estimate(pilot_queries(job, 8192), 16, STREAM)
        means.append(float(found.value_a.mean() + found.value_b.mean()))
    assert means[1] == pytest.approx(means[0], rel=0.01)
    assert means[2] < 0.95 * means[0]
