"""The effects plan omits negligible effects and keeps all others."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support import jobs
from support.height_maps import slope_normals
from support.jobs import height_field
from support.scenes import rocks

from mbtf_core.stats import Estimate, mean_of_halves
from mbtf_gen.planning.bounds import Change
from mbtf_gen.planning.effects_plan import EffectsPlan, without
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import plan_effects
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heightfield_tile import HeightFieldTile

QUERIES, SPP = 16384, 8


def pattern() -> NDArray[np.float32]:
    rng = np.random.default_rng(4)
    return (0.2 + 0.6 * rng.random((16, 16, 3))).astype(np.float32)


def bumps(strength: float) -> NDArray[np.float32]:
    """Normals of ripples along u."""
    x = (np.arange(64) + 0.5) / 64
    slope = np.broadcast_to(strength * np.cos(2 * np.pi * 4 * x), (64, 64))
    return slope_normals(np.stack([slope, 0 * slope], axis=-1)).astype(np.float32)


ROCKS = rocks(64, 1.0).z


material = partial(height_field, ROCKS)


def job_of(stuff: HeightFieldTile, mode: str = "auto", min_cos: float = 0.1, width: float = 1.0) -> Job:
    queries = {"min_cos": min_cos, "resolution": 64}
    return jobs.job_of(stuff, mode, queries=queries, light={"width": width}, transport={"max_depth": 0})


def estimates(job: Job, plan: EffectsPlan, seed: int = 1) -> Estimates:
    return build_estimator(job, plan).estimate(pilot_queries(job, QUERIES), SPP, Stream(seed, "test", 0))


def difference(x: Estimates, y: Estimates) -> Estimate:
    """Of the mean values, query by query, channels averaged."""
    a, b = (x.value_a - y.value_a).mean(axis=1), (x.value_b - y.value_b).mean(axis=1)
    return mean_of_halves(a, b)


GLOSS: dict[str, Any] = {"roughness": 0.4, "specular": 0.5, "metallic": 0.0}
SCENES: dict[str, tuple[HeightFieldTile, dict[str, Any]]] = {
    "dark relief": (material(0.15, 0.05), {}),
    "gray relief": (material(0.15, 0.5), {}),
    "white relief": (material(0.15, 0.95), {}),
    "faint relief": (material(2e-5, pattern()), {"min_cos": 0.3}),
    "gentle relief": (material(0.002, pattern()), {"min_cos": 0.6}),
    # Slopes up to 60°, light down to 33°.
    "rare shadows": (material(0.11, 0.5), {"min_cos": 0.6}),
    "pattern on a plane": (material(0.0, pattern()), {}),
    "gloss on a plane": (material(0.0, pattern(), **GLOSS), {}),
    "normal map on a plane": (material(0.0, 0.5, normal=bumps(0.3)), {}),
    "glossy relief": (material(0.1, 0.4, **GLOSS), {}),
    "metal relief": (material(0.1, 0.9, **{**GLOSS, "metallic": 1.0}), {}),
    "wide light": (material(0.1, 0.5), {"width": 10.0}),
    "delta light": (material(0.1, 0.5), {"width": 0.0}),
    "mirror relief": (material(0.02, 0.9, roughness=0.0, specular=0.5, metallic=1.0), {"width": 10.0}),
    "coated relief": (material(0.1, 0.3, clearcoat=1.0, clearcoat_roughness=0.4), {}),
    "velvet relief": (material(0.1, 0.3, sheen=1.0, sheen_roughness=0.3), {}),
    "holed relief": (material(0.1, 0.5, opacity=np.where(np.median(ROCKS) > ROCKS, 0.2, 1.0)), {}),
    # Layers so faint that they are not simulated.
    "faint gloss": (material(0.1, 0.5, roughness=0.5, specular=2e-4, metallic=0.0), {"min_cos": 0.3}),
    "faint coat": (material(0.1, 0.5, clearcoat=1e-4, clearcoat_roughness=0.3), {"min_cos": 0.3}),
    "faint sheen": (material(0.1, 0.5, sheen=2e-4, sheen_roughness=0.5), {"min_cos": 0.3}),
    "faint normal map": (material(0.0, pattern(), normal=bumps(2e-4)), {"min_cos": 0.3}),
    "faint holes": (material(0.1, 0.5, opacity=np.full((4, 4), 0.9995)), {"min_cos": 0.3}),
}


@cache
def planned(scene: str) -> tuple[Job, EffectsPlan]:
    stuff, options = SCENES[scene]
    job = job_of(stuff, **options)
    return job, plan_effects(job)


@pytest.mark.parametrize("scene", SCENES)
def test_what_is_left_out_does_not_matter(scene: str) -> None:
    """Against all effects on: a z-test of the mean values with the bias bound as tolerance."""
    job, plan = planned(scene)
    stuff, options = SCENES[scene]
    everything = job_of(stuff, "all", **options)
    full = estimates(everything, plan_effects(everything))
    cut = estimates(job, plan, seed=2)
    assert plan.bias_bound <= plan.tolerance
    found = difference(full, cut)
    mean = float(full.value_a.mean())
    assert abs(found.value) < 4 * found.error + plan.bias_bound * mean
    assert found.error < 0.02 * mean


CASES = [
    ("parallax", "gray relief", "pattern on a plane"),
    ("parallax", "gray relief", "faint relief"),
    ("shadowing", "gray relief", "gentle relief"),
    ("shadowing", "rare shadows", "gentle relief"),
    ("interreflection", "white relief", "gentle relief"),
    ("specular", "glossy relief", "gray relief"),
    ("metallic", "metal relief", "glossy relief"),
    ("normal", "normal map on a plane", "gray relief"),
    ("normal", "normal map on a plane", "faint normal map"),
    ("bsdf_sampling", "mirror relief", "glossy relief"),
    ("specular", "glossy relief", "faint gloss"),
    ("clearcoat", "coated relief", "faint coat"),
    ("sheen", "velvet relief", "faint sheen"),
    ("opacity", "holed relief", "faint holes"),
]


@pytest.mark.parametrize(("name", "needed", "idle"), CASES)
def test_an_effect_is_on_where_it_matters_and_off_where_not(name: str, needed: str, idle: str) -> None:
    job, plan = planned(needed)
    assert plan.on(name)
    assert not planned(idle)[1].on(name)
    found = Change.of(estimates(job, plan), estimates(job, without(plan, name)))
    assert found.rms > 2 * plan.tolerance
    assert found.upper < 1.5 * found.rms


def test_light_is_sampled_both_ways_only_where_it_helps() -> None:
    """Omitting BSDF sampling never changes the mean, and hardly the variance where the plan omits it."""
    job, plan = planned("glossy relief")
    assert not plan.on("bsdf_sampling")
    effects = tuple(replace(e, on=e.on or e.name == "bsdf_sampling") for e in plan.effects)
    both = replace(plan, effects=effects)
    one, two = estimates(job, plan), estimates(job, both, seed=2)
    found = difference(one, two)
    assert abs(found.value) < 4 * found.error
    # Medians, because a few queries with highlights of highlights dominate the variance.
    scatter = [float(np.median(np.abs(e.value_a - e.value_b))) for e in (one, two)]
    assert scatter[0] < 1.1 * scatter[1]
    mirror = SCENES["glossy relief"][0].with_maps(roughness=0.05)
    assert plan_effects(job_of(mirror)).on("bsdf_sampling")
