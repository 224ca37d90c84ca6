"""Qualities lie over files and under everything that is said explicitly."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from mbtf_fit.config import FitConfig
from mbtf_fit.quality import FITTER
from mbtf_gen.config import GeneratorConfig, count_queries
from mbtf_gen.quality import GENERATOR, Quality, as_assignments
from mbtf_gen.settings import resolve
from mbtf_pipeline.quality import COMPARE, quality_assignments
from mbtf_pipeline.recipe import load_recipe

QUALITIES = get_args(Quality)
ROOT = Path(__file__).parents[2]


def test_every_program_has_every_quality() -> None:
    assert list(GENERATOR) == list(FITTER) == list(COMPARE) == list(QUALITIES)


def test_each_quality_takes_more_paths_than_the_one_before() -> None:
    paths = []
    for quality in QUALITIES:
        config = resolve(GeneratorConfig, assignments=["material=m", *as_assignments(GENERATOR[quality])])
        paths.append(count_queries(config.queries.train, 128**2) * config.queries.spp)
    assert paths == sorted(paths)
    assert len(set(paths)) == len(paths)


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("name", ["quickstart", "ci"])
def test_recipes_take_a_quality(quality: Quality, name: str) -> None:
    path = ROOT / "pipelines" / f"{name}.yaml"
    recipe = load_recipe(path, quality_assignments(path, quality))
    assert recipe.generate.queries.train == GENERATOR[quality]["queries.train"]
    # What a quality does not speak of stays the recipe's.
    plain = load_recipe(path)
    assert recipe.generate.light == plain.generate.light
    assert list(recipe.fit) == list(plain.fit)
    for fit in recipe.fit.values():
        expected = resolve(FitConfig, assignments=as_assignments(FITTER[quality]))
        assert fit.training.steps == expected.training.steps
        if expected.training.steps is None:
            assert fit.training.time == expected.training.time
    assert recipe.compare.size == COMPARE[quality]["compare.size"]


def test_what_is_said_explicitly_wins(tmp_path: Path) -> None:
    path = ROOT / "pipelines" / "quickstart.yaml"
    said = [*quality_assignments(path, "draft"), "generate.queries.train=5/texel"]
    assert load_recipe(path, said).generate.queries.train == "5/texel"
    file = tmp_path / "fit.yaml"
    file.write_text("training: {steps: 7}\n")
    resolved = resolve(FitConfig, file=file, assignments=as_assignments(FITTER["draft"]))
    assert resolved.training.steps is None
    assert resolved.training.time == 20


def test_no_quality_changes_nothing() -> None:
    assert quality_assignments(ROOT / "pipelines" / "quickstart.yaml", None) == []
