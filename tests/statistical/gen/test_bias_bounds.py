"""Bias bounds against rendered differences, and the plane with slopes against the displaced tile."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support import jobs
from support.height_maps import slope_normals
from support.jobs import height_field

from mbtf_gen.planning import run_plan
from mbtf_gen.planning.bounds import Change, displacement_bounds
from mbtf_gen.planning.effects import bounce_bound
from mbtf_gen.planning.effects_plan import EffectsPlan, without
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import plan_effects
from mbtf_gen.planning.scene import EffectsRequest, PlanScene
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.heightfield_tile import HeightFieldTile

QUERIES = 8192


def waves(rows: int, columns: int) -> NDArray[np.float64]:
    """Smooth heights without symmetry, row 0 at v → 1."""
    x = 2 * np.pi * ((np.arange(columns) + 0.5) / columns)[None, :]
    y = 2 * np.pi * (1 - (np.arange(rows) + 0.5) / rows)[:, None]
    h = np.sin(x + 0.4) + 0.5 * np.sin(2 * x + y) + 0.7 * np.sin(2 * y + 0.9) + 0.3 * np.sin(3 * y - x)
    return (h - h.min()) / np.ptp(h)


job_of = partial(jobs.job_of, queries={"min_cos": 0.4}, transport={"max_depth": 1})
lambert = partial(height_field, color=(0.7, 0.5, 0.2))


def estimates(job: Job, plan: EffectsPlan, spp: int = 8) -> Estimates:
    return build_estimator(job, plan).estimate(pilot_queries(job, QUERIES), spp, Stream(1, "test", 0))


def tilted(rows: int, columns: int) -> NDArray[np.float32]:
    """A normal map of ripples that the heights do not have."""
    v = 2 * np.pi * (1 - (np.arange(rows) + 0.5) / rows)[:, None]
    u = 2 * np.pi * ((np.arange(columns) + 0.5) / columns)[None, :]
    slopes = np.stack(np.broadcast_arrays(0.05 * np.cos(5 * u) + 0 * v, 0.08 * np.cos(4 * v + u)), axis=-1)
    return slope_normals(slopes).astype(np.float32)


@pytest.mark.parametrize("mapped", [False, True], ids=["plain", "normal map"])
@pytest.mark.parametrize("shape", [(64, 64), (32, 64), (64, 32)])
def test_a_plane_with_slopes_lacks_nothing_but_parallax(shape: tuple[int, int], mapped: bool) -> None:
    """A faint displacement changes shading only; slopes of the wrong sign or row would double the change."""
    stuff = lambert(waves(*shape), 0.004, normal=tilted(*shape) if mapped else None)
    high: dict[str, Any] = {"queries": {"min_cos": 0.7, "resolution": 32}}
    full_job, cut_job = job_of(stuff, "all", **high), job_of(stuff, "all,-parallax", **high)
    bare_job = job_of(replace(stuff, height_scale=0.0), "all,-parallax", **high)
    full = estimates(full_job, plan_effects(full_job))
    upper = Change.of(full, estimates(cut_job, plan_effects(cut_job))).upper
    bare = Change.of(full, estimates(bare_job, plan_effects(bare_job))).rms
    assert bare > 0.002
    assert upper < 0.25 * bare


def finest_job(stuff: HeightFieldTile, mode: str) -> Job:
    """A job with footprints far smaller than a cell, for which bounds are estimated."""
    queries = {"min_cos": 0.3, "resolution": 512, "mixture": {"log_uniform": 0.0, "finest": 1.0}}
    return job_of(stuff, mode, queries=queries, light={"width": 0.0})


@pytest.mark.parametrize("shape", [(64, 64), (32, 64)])
def test_bias_bounds_equal_the_rendered_change(shape: tuple[int, int]) -> None:
    """They are tight at points, under a delta light, with direct light only."""
    rng = np.random.default_rng(4)
    base = np.repeat(np.repeat(0.1 + 0.8 * rng.random((8, 8)), shape[0] // 8, 0), shape[1] // 8, 1)
    color = np.repeat(base[..., None], 3, axis=-1).astype(np.float32)
    stuff = lambert(waves(*shape), 0.25, normal=tilted(*shape)).with_maps(base_color=color)
    job = finest_job(stuff, "all")
    plan = plan_effects(job)
    queries = pilot_queries(job, QUERIES)
    mapped = job.material.normal_slopes()
    light_and_view = (w.astype(np.float64) for w in (queries.omega_i, queries.omega_o))
    bounds = displacement_bounds(
        job.material.grid, *light_and_view, LightKernel(0.0), base[..., None], mapped[0]
    )
    # The plane's slopes alone: the bound of parallax ignores the normal map.
    plain = finest_job(stuff.with_maps(normal=None), "all")
    bare = plan_effects(plain)
    full = estimates(plain, bare)
    assert bounds.opacity == 0.0
    for name, bound in (("parallax", bounds.parallax), ("shadowing", bounds.shadowing)):
        measured = Change.of(full, estimates(plain, without(bare, name))).rms
        assert bound == pytest.approx(measured, rel=0.3), name
    measured = Change.of(estimates(job, plan), estimates(job, without(plan, "normal"))).rms
    assert bounds.normal == pytest.approx(measured, rel=0.3)


def test_the_tolerance_is_shared_not_spent_twice() -> None:
    """If two effects fit the tolerance only one at a time, one of them stays on."""
    normal = tilted(32, 32)
    stuff = lambert(waves(32, 32), 0.05, normal=normal, opacity=np.full((4, 4), 0.99))
    alone = plan_effects(job_of(stuff, effects={"tolerance": 0.0}))
    bounds = sorted((alone["opacity"].bias_bound or 0.0, alone["normal"].bias_bound or 0.0))
    assert bounds[0] > 0
    tolerance = bounds[1] + 0.5 * bounds[0]
    plan = plan_effects(job_of(stuff, effects={"tolerance": tolerance}))
    assert plan.bias_bound <= tolerance
    assert plan.on("opacity") != plan.on("normal")


def test_the_bias_bound_of_holes_is_near_the_rendered_change() -> None:
    """Crests that transmit most light cover little of the view from above, but they shade the rest."""
    heights = waves(64, 64)
    opacity = np.where(heights > np.quantile(heights, 0.8), 0.3, 1.0)
    stuff = lambert(heights, 0.4, opacity=opacity)
    job = finest_job(stuff, "all")
    plan = plan_effects(job)
    found = Change.of(estimates(job, plan, 32), estimates(job, without(plan, "opacity"), 32)).rms
    stated = plan_effects(finest_job(stuff, "auto"))["opacity"]
    assert stated.on
    assert found < stated.bias_bound < 1.6 * found


def test_on_a_plane_the_bias_bound_of_holes_is_exact() -> None:
    """M is opacity times ρ/π: a hundredth of the tile, twice as bright, transmits a share p."""
    opacity, base = np.ones((10, 10)), np.full((10, 10, 3), 0.4)
    opacity[3, 4], base[3, 4] = 0.7, 0.8
    stuff = lambert(np.zeros((10, 10)), 1.0, opacity=opacity).with_maps(base_color=base)
    mean = (0.4 * 99 + 0.8 * 0.7) / 100
    assert plan_effects(job_of(stuff))["opacity"].bias_bound == pytest.approx(0.3 * 0.8 / 10 / mean)


class Rare:
    """Replaces a pilot: few queries change, but by much."""

    hits, size = 3, 0.15

    def __init__(self, *_: Any) -> None:
        pass

    def limited(self, limit: int) -> Change:
        change = np.zeros((QUERIES, 3), np.float32)
        change[: self.hits] = self.size
        one = np.ones((QUERIES, 3), np.float32)
        full, cut = (Estimates(v, v, None, 1, 0, 0, 0) for v in (one + change, one))
        return Change.of(full, cut)


def test_rare_large_changes_keep_an_effect_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of eight thousand queries change, so the bound must allow for nine."""
    monkeypatch.setattr(run_plan, "Pilot", Rare)
    job = job_of(lambert(waves(32, 32), 0.3), transport={"max_depth": 0})
    assert Rare().limited(1).upper < job.config.effects.tolerance
    plan = plan_effects(job)
    assert plan.on("interreflection")
    assert plan.max_depth == 0
    # The same change spread over all queries is left out.
    monkeypatch.setattr(Rare, "hits", QUERIES)
    monkeypatch.setattr(Rare, "size", 0.002)
    assert not plan_effects(job).on("interreflection")


@pytest.mark.parametrize("spread", [0.5, 1.0, 1.5])
def test_bounds_hold_for_heavy_tails(spread: float) -> None:
    """Lognormal changes: in at most 5 of 100 samples the bound lies below the true value."""
    rng = np.random.default_rng(2)
    one = np.ones((2000, 3), np.float32)
    scale = 0.01
    wrong = 0
    for _ in range(100):
        change = scale * np.exp(spread * rng.normal(size=(2000, 1))) * one
        # Each half sees a third of them.
        halves = (one + change * (rng.random((2000, 1)) < 0.3) / 0.3 for _ in "ab")
        full = Estimates(*(h.astype(np.float32) for h in halves), None, 1, 0, 0, 0)
        found = Change.of(full, Estimates(one, one, None, 1, 0, 0, 0))
        mean = 1 + scale * np.exp(0.5 * spread**2)
        wrong += found.bound() < scale * np.exp(spread**2) / mean
    assert wrong <= 5


def test_the_bound_is_positive_where_no_query_changes() -> None:
    one = np.ones((2000, 3), np.float32)
    still = Estimates(one, one, None, 1, 0, 0, 0)
    none = Change.of(still, still)
    assert none.upper == 0.0
    assert none.bound() > 0.03
    # Theory may give a smaller bound.
    assert none.bound(1e-3) < 2e-3


@pytest.mark.parametrize("slope", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("share", [1.0, 0.1, 1e-3])
def test_the_bounce_bound_is_above_that_of_grooves(slope: float, share: float) -> None:
    """V-grooves far finer than white patches on black: a facet sees 1-cos(atan s) of its neighbor, lit as
    strongly. The patches cover a `share` of the tile, so RMS over mean is 1/√share."""
    columns = 1000
    z = np.tile(slope * np.array([0.0, 1.0, 2.0, 1.0]) / columns, (columns, columns // 4))
    base = np.zeros((1, columns, 3))
    base[:, : round(share * columns)] = 0.9
    stuff = replace(lambert(z, 1.0), maps={"base_color": base})
    job = job_of(stuff, queries={"min_cos": 0.99}, light={"width": 0.0}, geometry={"mesh": columns})
    bound = bounce_bound(PlanScene(job, EffectsRequest("auto", {})))
    seen = 0.9 * (1 - np.cos(np.arctan(slope)))
    assert bound > seen / np.sqrt(share)
