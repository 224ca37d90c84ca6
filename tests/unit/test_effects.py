"""Which effects a run says that it simulates."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mbtf_gen.config import GeneratorConfig
from mbtf_gen.effects import simulated_effects
from mbtf_gen.material import Material

HEIGHTS = np.array([[0.0, 0.1], [0.05, 0.02]])
LAMBERT = Material(height=HEIGHTS, height_scale=1.0, height_bits=None, basecolor=np.full(3, 0.5))
GEOMETRIC = {"parallax and masking", "shadowing", "interreflection", "periodic neighbours"}


def effects(material: Material, **options: Any) -> set[str]:
    config = GeneratorConfig.model_validate({"material": "m", **options})
    return {e["effect"] for e in simulated_effects(material, config) if e["on"]}


def test_a_relief_of_lambert_has_geometric_effects_and_the_smoothed_light() -> None:
    assert effects(LAMBERT) == {*GEOMETRIC, "smoothed light"}


@pytest.mark.parametrize(
    ("material", "options"),
    [
        (LAMBERT, {"geometry": {"height": 0.0}}),
        (replace(LAMBERT, height=np.full((2, 2), 0.4)), {}),
        (replace(LAMBERT, height_scale=0.0), {}),
    ],
    ids=["no factor", "constant map", "material's factor"],
)
def test_a_plane_has_none_of_the_geometric_ones(material: Material, options: dict[str, Any]) -> None:
    assert effects(material, **options) == {"smoothed light"}


def test_options_switch_effects_off() -> None:
    assert effects(LAMBERT, transport={"max_depth": 1}) == {*GEOMETRIC, "smoothed light"} - {
        "interreflection"
    }
    assert effects(LAMBERT, transport={"max_depth": 2}) >= GEOMETRIC
    assert effects(LAMBERT, light={"width": 0}) == GEOMETRIC


def test_a_surface_with_roughness_has_a_specular_lobe() -> None:
    shiny = replace(LAMBERT, roughness=0.4, metallic=0.0, specular=0.5)
    assert "specular lobe" in effects(shiny)


def test_maps_that_are_not_simulated_say_so() -> None:
    material = replace(LAMBERT, normal=np.zeros((2, 2, 3), np.float32), opacity=0.5)
    config = GeneratorConfig(material="m")
    said = {e["effect"]: e for e in simulated_effects(material, config)}
    for name in ("normal map", "opacity"):
        assert not said[name]["on"]
        assert said[name]["reason"] == "not simulated yet"
        assert {e["effect"]: e for e in simulated_effects(LAMBERT, config)}[name]["reason"] == "no map"


def test_every_effect_has_a_reason() -> None:
    for e in simulated_effects(LAMBERT, GeneratorConfig(material="m")):
        assert e["reason"]
        assert isinstance(e["on"], bool)
