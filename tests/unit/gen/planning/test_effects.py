"""Effects plan: what is asked for, what depends on what, and what a manifest keeps of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mbtf_core.errors import UsageError
from mbtf_gen.config.effects_request import EFFECTS, OF_RELIEF, EffectsRequest
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation import Job
from mbtf_gen.material.material import Material
from mbtf_gen.planning.effects import Effect, EffectsPlan
from mbtf_gen.planning.effects_plan import plan_effects, simulated

HEIGHTS = np.array([[0.0, 0.1], [0.05, 0.02]])
LAMBERT = Material(height=HEIGHTS, height_scale=1.0, height_bits=None, base_color=np.full(3, 0.5))
FLAT = replace(LAMBERT, height_scale=0.0)
NORMAL = np.broadcast_to(np.float32([0.6, 0.0, 0.8]), (4, 4, 3))


def job_of(material: Material, mode: str = "auto", **options: Any) -> Job:
    sections: dict[str, Any] = {"effects": {"mode": mode}, **options}
    return Job.of(GeneratorConfig.model_validate({"material": "m", **sections}), material)


def on(plan: EffectsPlan) -> set[str]:
    return {e.name for e in plan.effects if e.on}


def test_a_plane_of_one_color_is_known_without_tracing() -> None:
    for material in (FLAT, replace(LAMBERT, height=np.full((2, 2), 0.4))):
        plan = plan_effects(job_of(material))
        assert on(plan) == set()
        assert plan.closed_form
        assert plan.cost == 0.0
        assert all(e.known == "exact" for e in plan.effects)


@pytest.mark.parametrize(
    "change",
    [
        {"base_color": np.full((2, 2, 3), 0.5) * [[[1.0], [0.5]]]},
        {"roughness": 0.5, "specular": 0.5, "metallic": 0.0},
        {"normal": NORMAL},
        {"opacity": np.array([[1.0, 0.0], [1.0, 1.0]])},
    ],
    ids=["pattern", "gloss", "normal map", "holes"],
)
def test_a_plane_with_more_on_it_is_not(change: dict[str, Any]) -> None:
    plan = plan_effects(job_of(replace(FLAT, **change)))
    assert not plan.closed_form
    assert not on(plan) & set(OF_RELIEF)


def test_black_is_known_whatever_the_relief() -> None:
    black = replace(LAMBERT, base_color=np.zeros(3))
    assert plan_effects(job_of(black)).closed_form
    # A black dielectric still has highlights, and black cloth still has holes.
    shiny = replace(black, roughness=0.5, specular=0.5, metallic=0.0)
    assert not simulated(job_of(shiny)).closed_form
    holes = replace(black, opacity=np.array([[1.0, 0.0], [1.0, 1.0]]))
    assert not plan_effects(job_of(holes, mode="-interreflection")).closed_form


def test_all_and_none_force_everything_that_the_material_has() -> None:
    everything = plan_effects(job_of(FLAT, "all"))
    assert on(everything) == {*OF_RELIEF, "mis"}
    assert not everything.closed_form
    nothing = plan_effects(job_of(replace(LAMBERT, roughness=0.5, specular=0.5, metallic=0.5), "none"))
    assert on(nothing) == set()


def test_effects_can_be_asked_for_and_away() -> None:
    plan = plan_effects(job_of(LAMBERT, "-interreflection,+mis"))
    assert not plan.on("interreflection")
    assert plan.on("mis")
    assert plan["interreflection"].reason.startswith("asked away")
    assert plan_effects(job_of(FLAT, "all,-shadowing")).on("shadowing") is False


def test_what_needs_an_effect_goes_with_it() -> None:
    assert on(plan_effects(job_of(LAMBERT, "-masking"))) == set()
    with pytest.raises(UsageError, match="'shadowing' needs 'parallax and masking'"):
        plan_effects(job_of(LAMBERT, "-masking,+shadowing"))


def test_the_tile_repeats_by_construction() -> None:
    with pytest.raises(UsageError, match="cannot be left out"):
        plan_effects(job_of(LAMBERT, "-neighbors"))
    low = plan_effects(job_of(LAMBERT, queries={"min_cos": 0.2}, light={"width": 0.0}), pilots=False)
    # A relief of 0.1 seen from 11.5 degrees.
    assert "up to 0.49 tiles" in low["neighbors"].reason
    assert (
        "any number"
        in plan_effects(job_of(LAMBERT, queries={"min_cos": 0.01}), pilots=False)["neighbors"].reason
    )
    assert not plan_effects(job_of(FLAT)).on("neighbors")


@pytest.mark.parametrize("name", ["specular", "metallic", "coat", "sheen", "normal", "opacity", "fibers"])
def test_what_a_material_lacks_cannot_be_asked_for(name: str) -> None:
    with pytest.raises(UsageError, match="the material has none"):
        plan_effects(job_of(LAMBERT, f"+{name}"))
    assert not plan_effects(job_of(LAMBERT, "all")).on(name)


@pytest.mark.parametrize("text", ["", "every", "+", "-depth", "none,shadowing", "+shadowing,auto"])
def test_unknown_words_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is no effect"):
        EffectsRequest.parse(text)


def test_a_manifest_keeps_the_plan() -> None:
    plan = simulated(job_of(LAMBERT, "-mis"))
    assert [e.name for e in plan.effects] == list(EFFECTS)
    assert EffectsPlan.from_manifest(plan.to_manifest()) == plan


def test_costs_add_up_over_what_is_left_out() -> None:
    effects = (
        Effect("masking", True, "", 0.5),
        Effect("shadowing", False, "", 0.001),
        Effect("mis", False, "", 0.002),
    )
    assert EffectsPlan(effects).cost == pytest.approx(0.003)


def test_a_depth_limit_is_kept() -> None:
    plan = plan_effects(job_of(LAMBERT, transport={"max_depth": 1}))
    assert not plan.on("interreflection")
    plan = plan_effects(job_of(LAMBERT, transport={"max_depth": 3}))
    assert (plan.on("interreflection"), plan.max_depth) == (True, 3)


def test_a_small_run_is_not_looked_at_twice() -> None:
    """What no theory decides stays on, without a cost."""
    plan = plan_effects(job_of(replace(LAMBERT, base_color=np.full(3, 0.05))), pilots=False)
    assert on(plan) == set(OF_RELIEF)
    assert (plan["interreflection"].cost, plan["masking"].cost, plan.max_depth) == (None, None, 0)
    assert plan_effects(job_of(FLAT), pilots=False).closed_form


COAT: dict[str, Any] = {"clearcoat": 1.0, "clearcoat_roughness": 0.1}


def test_black_under_a_coat_is_not_black() -> None:
    black = replace(LAMBERT, base_color=np.zeros(3), **COAT)
    plan = plan_effects(job_of(black), pilots=False)
    assert not plan.closed_form
    assert on(plan) >= {*OF_RELIEF, "coat"}


GLOSS: dict[str, Any] = {"roughness": 0.5, "specular": 0.5, "metallic": 0.0}


@pytest.mark.parametrize("more", [GLOSS, COAT, {**GLOSS, **COAT}, {"sheen": 1.0, "sheen_roughness": 0.3}])
def test_costs_of_lambert_are_not_stated_for_gloss(more: dict[str, Any]) -> None:
    """Estimates shade Lambert; on anything else they would be wrong by any factor."""
    stuff = replace(LAMBERT, normal=NORMAL, opacity=np.full((2, 2), 0.999), **more)
    everything = dict.fromkeys(("masking", "shadowing", "normal", "opacity"))
    plan = plan_effects(job_of(stuff, transport={"max_depth": 1}, effects={"mode": "all"}))
    assert {name: plan[name].cost for name in everything} == everything
    lambert = replace(LAMBERT, normal=NORMAL, opacity=np.full((2, 2), 0.999))
    plan = plan_effects(job_of(lambert, transport={"max_depth": 1}))
    assert all(plan[name].cost for name in everything)


def test_the_smoothest_place_decides_how_light_is_found() -> None:
    """A light of one degree against lobes of 2α; Lambert needs no second way."""
    dull = {"roughness": 0.6, "specular": 0.5, "metallic": 0.0}
    patch = np.full((8, 8), 0.6)
    patch[3, 3] = 0.02
    assert not plan_effects(job_of(replace(FLAT, **dull))).on("mis")
    assert plan_effects(job_of(replace(FLAT, **{**dull, "roughness": patch}))).on("mis")
    assert plan_effects(job_of(replace(FLAT, **dull, clearcoat=1.0, clearcoat_roughness=0.05))).on("mis")
    assert not plan_effects(job_of(FLAT, "+masking")).on("mis")
    sheen = {"sheen": 0.5, "sheen_roughness": 0.5}
    assert not plan_effects(job_of(replace(FLAT, **sheen))).on("mis")
    assert plan_effects(job_of(replace(FLAT, **{**sheen, "sheen_roughness": 0.05}))).on("mis")


def test_the_configured_roulette_and_cap_reach_the_plan() -> None:
    plan = plan_effects(job_of(LAMBERT, transport={"roulette_depth": 7, "max_depth": 5}), pilots=False)
    assert (plan.roulette_depth, plan.max_depth) == (7, 5)
    pictures = simulated(job_of(LAMBERT, "all,-shadowing"))
    assert not pictures.on("shadowing")
    assert pictures.max_depth == 0


def test_a_bsdf_of_the_users_own_is_taken_as_it_is() -> None:
    own = replace(LAMBERT, bsdf={"type": "diffuse"})
    assert simulated(job_of(own, "none")).on("specular")
    assert simulated(job_of(own, "+specular")).on("specular")
    with pytest.raises(UsageError, match="the material has none"):
        simulated(job_of(own, "+metallic"))
