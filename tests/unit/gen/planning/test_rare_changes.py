"""Bias bounds of changes too rare for the sample are upper bounds, never zero."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import measured, plan_effects
from mbtf_gen.tile.heightfield_tile import HeightFieldTile

# Root mean square change at 131 072 points of the bump below, without its shadows.
TRUE_CHANGE = 0.0087


def one_bump(cells: int = 64) -> Job:
    """A plane with one bump of slopes up to 61°, under light no lower than 33°: shadows are rare."""
    height = np.zeros((cells, cells))
    height[cells // 2, cells // 2] = 1.0
    config = {"material": "m", "queries": {"min_cos": 0.6, "resolution": cells}}
    material = HeightFieldTile(height=height, height_scale=1.28 / cells, maps={"base_color": np.full(3, 0.5)})
    return Job.of(GeneratorConfig.model_validate(config), material)


@pytest.mark.parametrize("cells", [64, 128])
def test_shadows_that_no_ray_met_have_an_upper_bound(cells: int) -> None:
    plan = plan_effects(one_bump(cells))
    shadowing = plan["shadowing"]
    assert shadowing.on
    assert shadowing.reason == "pilot"
    assert shadowing.bias_bound is not None
    assert TRUE_CHANGE < shadowing.bias_bound < 0.1


def test_a_plan_never_measures_a_rare_change_as_exactly_zero() -> None:
    job = one_bump(128)
    shadowing = measured(job, plan_effects(job))["shadowing"]
    assert shadowing.bias_bound is not None
    assert shadowing.bias_bound + 2 * shadowing.error > TRUE_CHANGE
