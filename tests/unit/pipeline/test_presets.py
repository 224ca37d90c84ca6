"""Quality presets override files; explicit options override the presets."""

from __future__ import annotations

import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.app.options import Quality
from mbtf_core.config.settings import resolve
from mbtf_fit.config import FITTER, FitConfig, best_options
from mbtf_fit.sections import TimeBudget
from mbtf_gen.config.generator import GENERATOR, GeneratorConfig, count_queries
from mbtf_pipeline.recipe import COMPARE, load_recipe, preset_recipe, quality_options

QUALITIES: tuple[Quality, ...] = get_args(Quality)


def test_each_preset_takes_more_paths_than_the_one_before() -> None:
    paths = []
    for quality in QUALITIES:
        config = resolve(GeneratorConfig, presets={"material": "m", **GENERATOR[quality]})
        paths.append(count_queries(config.queries.train, 128**2) * config.queries.spp)
    assert paths == sorted(set(paths))


@pytest.mark.parametrize("quality", QUALITIES)
def test_recipes_take_a_preset(quality: Quality) -> None:
    path = ROOT / "pipelines" / "quickstart.yaml"
    recipe = preset_recipe(path, quality)
    assert recipe.generate.queries.train == GENERATOR[quality]["queries.train"]
    plain = load_recipe(path)
    assert recipe.generate.light == plain.generate.light
    assert list(recipe.fit) == list(plain.fit)
    for fit in recipe.fit.values():
        expected = resolve(FitConfig, presets=FITTER[quality])
        assert fit.training.steps == expected.training.steps
        if expected.training.steps is None:
            assert fit.training.time.seconds == expected.training.time.seconds
    assert recipe.compare.size == COMPARE[quality]["compare.size"]


@pytest.mark.parametrize("name", ["models", "hierarchical"])
@pytest.mark.parametrize("quality", QUALITIES)
def test_recipes_that_compare_networks_keep_them(quality: Quality, name: str) -> None:
    path = ROOT / "pipelines" / f"{name}.yaml"
    plain, raised = load_recipe(path), load_recipe(path, presets=quality_options(path, quality))
    assert {n: f.network for n, f in raised.fit.items()} == {n: f.network for n, f in plain.fit.items()}
    for one, fit in raised.fit.items():
        if plain.fit[one].training.blur.initial_sigma == 0 or fit.model == "hierarchical":
            assert fit.training.blur == plain.fit[one].training.blur


def test_longer_training_gets_a_larger_network() -> None:
    widths = [best_options(seconds)["network.width"] for seconds in (1.0, 20.0, 600.0, math.inf)]
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]
    path = ROOT / "pipelines" / "rock_cliff.yaml"
    assert quality_options(path, "high")["fit.neumip.network.width"] == 64


def test_a_section_overrides_the_preset_value_by_value(tmp_path: Path) -> None:
    np.save(tmp_path / "height.npy", np.zeros((8, 8)))
    path = tmp_path / "recipe.yaml"
    path.write_text("name: r\ngenerate: {material: height.npy}\nfit: {neumip: {}}\n")
    for section, single in (
        ("fit.neumip={network: {width: 7}}", "fit.neumip.network.width=7"),
        ("fit={neumip: {training: {blur: {fraction: 0.4}}}}", "fit.neumip.training.blur.fraction=0.4"),
    ):
        found, expected = (preset_recipe(path, "draft", [text]) for text in (section, single))
        assert found == expected
        assert found.fit["neumip"].training.time == TimeBudget(12.0, 800)


def test_a_preset_sets_the_resolution_unless_told(tmp_path: Path) -> None:
    """A draft of large maps is a draft; explicit resolutions of recipes and assignments are kept."""
    np.save(tmp_path / "height.npy", np.zeros((256, 256)))
    path = tmp_path / "recipe.yaml"
    text = "name: r\ngenerate: {material: height.npy, geometry: {height_scale: 1}}\nfit: {model: neumip}\n"
    path.write_text(text)
    found = [preset_recipe(path, quality).generate.queries.resolution for quality in QUALITIES]
    # No finer than the map, whose own is the paper's.
    assert found == [128, 256, 256, None]
    told = preset_recipe(path, "draft", ["generate.queries.resolution=512"])
    assert told.generate.queries.resolution == 512
