"""Effects plan: requests, dependencies between effects, and the manifest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import call
from support.jobs import height_field, job_of

from mbtf_core.errors import UsageError
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import measured, plan_effects, plan_run, reference_plan

HEIGHTS = np.array([[0.0, 0.1], [0.05, 0.02]])
LAMBERT = height_field(HEIGHTS, 1.0)
FLAT = replace(LAMBERT, height_scale=0.0)
GLOSS: dict[str, Any] = {"roughness": 0.5, "specular": 0.5, "metallic": 0.0}
COAT: dict[str, Any] = {"clearcoat": 1.0, "clearcoat_roughness": 0.1}
NORMAL = np.broadcast_to(np.float32([0.6, 0.0, 0.8]), (4, 4, 3))

DISPLACEMENT_EFFECTS = [name for name, effect in EFFECTS.items() if effect.displaced]


def on(plan: EffectsPlan) -> set[str]:
    return {e.name for e in plan.effects if e.on}


def test_a_plane_of_one_color_has_a_closed_form() -> None:
    for material in (FLAT, replace(LAMBERT, height=np.full((2, 2), 0.4))):
        plan = plan_effects(job_of(material))
        assert on(plan) == set()
        assert plan.closed_form
        assert plan.bias_bound == 0.0
        assert all(e.reason == "exact" for e in plan.effects)


@pytest.mark.parametrize(
    "change",
    [
        {"base_color": np.full((2, 2, 3), 0.5) * [[[1.0], [0.5]]]},
        GLOSS,
        {"normal": NORMAL},
        {"opacity": np.array([[1.0, 0.0], [1.0, 1.0]])},
    ],
    ids=["pattern", "gloss", "normal map", "holes"],
)
def test_other_planes_have_none(change: dict[str, Any]) -> None:
    plan = plan_effects(job_of(FLAT.with_maps(**change)))
    assert not plan.closed_form
    assert not on(plan) & set(DISPLACEMENT_EFFECTS)


def test_black_has_a_closed_form_at_any_displacement() -> None:
    black = replace(LAMBERT, maps={"base_color": np.zeros(3)})
    assert plan_effects(job_of(black)).closed_form
    # A black dielectric still has highlights, and black cloth still has holes.
    coated = plan_effects(job_of(black.with_maps(**COAT)), pilots=False)
    assert not coated.closed_form
    assert on(coated) >= {*DISPLACEMENT_EFFECTS, "clearcoat"}
    holes = black.with_maps(opacity=np.array([[1.0, 0.0], [1.0, 1.0]]))
    assert not plan_effects(job_of(holes, mode="-interreflection")).closed_form


def test_effects_can_be_forced_on_and_off() -> None:
    plan = plan_effects(job_of(LAMBERT, "-interreflection,+bsdf_sampling"))
    assert not plan.on("interreflection")
    assert plan.on("bsdf_sampling")
    assert plan["interreflection"].reason == "forced"
    assert plan_effects(job_of(FLAT, "all,-shadowing")).on("shadowing") is False
    with pytest.raises(UsageError, match=r"'\+gloss' is not an effect"):
        plan_effects(job_of(LAMBERT, "+gloss"))


def test_effects_that_need_the_displaced_tile_are_off_without_it() -> None:
    assert on(plan_effects(job_of(LAMBERT, "-parallax"))) == set()
    with pytest.raises(UsageError, match="'shadowing' needs 'parallax and masking'"):
        plan_effects(job_of(LAMBERT, "-parallax,+shadowing"))


@pytest.mark.parametrize(
    "name", ["specular", "metallic", "clearcoat", "sheen", "transmission", "normal", "opacity"]
)
def test_effects_that_the_material_lacks_cannot_be_forced_on(name: str) -> None:
    with pytest.raises(UsageError, match="the material has none"):
        plan_effects(job_of(LAMBERT, f"+{name}"))
    assert not plan_effects(job_of(LAMBERT, "all")).on(name)


def test_a_small_run_has_no_pilot() -> None:
    """Effects without a bound from theory stay on."""
    plan = plan_effects(job_of(replace(LAMBERT, maps={"base_color": np.full(3, 0.05)})), pilots=False)
    assert on(plan) == set(DISPLACEMENT_EFFECTS)
    assert plan["interreflection"].bias_bound is plan["parallax"].bias_bound is None
    assert plan.max_depth == 0
    assert plan_effects(job_of(FLAT), pilots=False).closed_form


@pytest.mark.parametrize("more", [GLOSS, COAT, {**GLOSS, **COAT}, {"sheen": 1.0, "sheen_roughness": 0.3}])
def test_bounds_for_lambert_do_not_apply_to_gloss(more: dict[str, Any]) -> None:
    """They shade Lambert; on other surfaces their error has no limit."""
    stuff = LAMBERT.with_maps(normal=NORMAL, opacity=np.full((2, 2), 0.999), **more)
    everything = dict.fromkeys(("parallax", "shadowing", "normal", "opacity"))
    plan = plan_effects(job_of(stuff, transport={"max_depth": 1}, effects={"mode": "all"}))
    assert {name: plan[name].bias_bound for name in everything} == everything
    lambert = LAMBERT.with_maps(normal=NORMAL, opacity=np.full((2, 2), 0.999))
    plan = plan_effects(job_of(lambert, transport={"max_depth": 1}))
    assert all(plan[name].bias_bound for name in everything)


def test_the_smallest_roughness_decides_on_bsdf_sampling() -> None:
    """A light of one degree against lobes of 2α; Lambert needs none."""

    def sampled(**maps: Any) -> bool:
        return plan_effects(job_of(FLAT.with_maps(**maps))).on("bsdf_sampling")

    patch = np.full((8, 8), 0.6)
    patch[3, 3] = 0.02
    dull = {**GLOSS, "roughness": 0.6}
    assert not sampled(**dull)
    assert sampled(**{**dull, "roughness": patch})
    assert sampled(**dull, clearcoat=1.0, clearcoat_roughness=0.05)
    assert not plan_effects(job_of(FLAT, "+parallax")).on("bsdf_sampling")
    assert sampled(sheen=0.5, sheen_roughness=0.05)


def test_the_configured_roulette_and_cap_reach_the_plan() -> None:
    plan = plan_effects(job_of(LAMBERT, transport={"roulette_depth": 7, "max_depth": 5}), pilots=False)
    assert (plan.roulette_depth, plan.max_depth) == (7, 5)
    for depth, interreflection in ((1, False), (3, True)):
        plan = plan_effects(job_of(LAMBERT, transport={"max_depth": depth}))
        assert plan.on("interreflection") is interreflection
    assert plan.max_depth == 3
    assert reference_plan(job_of(LAMBERT, "all,-shadowing")).max_depth == 0


def test_a_bsdf_of_the_user_cannot_be_switched() -> None:
    own = replace(LAMBERT, bsdf={"type": "diffuse"})
    assert reference_plan(job_of(own, "none")).on("specular")
    assert reference_plan(job_of(own, "+specular")).on("specular")
    with pytest.raises(UsageError, match="the material has none"):
        reference_plan(job_of(own, "+metallic"))


# Root mean square change at 131 072 points of the bump below, without its shadows.
TRUE_CHANGE = 0.0087


def one_bump(cells: int = 64) -> Job:
    """A plane with one bump of slopes up to 61°, under light no lower than 33°: shadows are rare."""
    height = np.zeros((cells, cells))
    height[cells // 2, cells // 2] = 1.0
    queries = {"min_cos": 0.6, "resolution": cells}
    return job_of(height_field(height, 1.28 / cells), queries=queries)


@pytest.mark.parametrize("cells", [64, 128])
def test_shadows_that_no_ray_met_have_an_upper_bound(cells: int) -> None:
    plan = plan_effects(one_bump(cells))
    shadowing = plan["shadowing"]
    assert shadowing.on
    assert shadowing.reason == "pilot"
    assert TRUE_CHANGE < shadowing.bias_bound < 0.1


def test_a_plan_never_measures_a_rare_change_as_exactly_zero() -> None:
    job = one_bump(128)
    shadowing = measured(job, plan_effects(job))["shadowing"]
    assert shadowing.bias_bound + 2 * shadowing.error > TRUE_CHANGE


def test_the_printed_plan_is_that_of_the_run(tmp_path: Path) -> None:
    """Which is too small for pilots."""
    np.save(tmp_path / "heights.npy", np.random.default_rng(0).random((16, 16)))
    words = ["mbtf-gen", "plan", str(tmp_path / "heights.npy"), "--height-scale", "0.05"]
    stated = call([*words, "--queries", "1/texel", "--json"]).result()
    config = {"material": str(tmp_path / "heights.npy"), "geometry": {"height_scale": 0.05}}
    job = Job.load(GeneratorConfig.model_validate({**config, "queries": {"train": "1/texel"}}))
    run = plan_run(job).effects
    assert (stated["max_depth"], stated["bias_bound"]) == (run.max_depth, run.bias_bound) == (0, 0.0)
    assert plan_effects(job).max_depth > 0
