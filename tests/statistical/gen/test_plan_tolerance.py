"""Plans stay within their tolerance on adversarial materials."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.height_maps import fractal, slope_normals
from support.jobs import height_field, job_of
from support.paths import ROOT

from mbtf_gen.planning.bounds import Change
from mbtf_gen.planning.run_plan import plan_effects, reference_plan
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Stream
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.heights import HeightGrid, height_slopes, residual_slopes
from mbtf_gen.tile.loading import load_material


def ripples(strength: float) -> NDArray[np.float64]:
    x = (np.arange(64) + 0.5) / 64
    slope = np.broadcast_to(strength * np.cos(2 * np.pi * 4 * x), (64, 64))
    return slope_normals(np.stack([slope, 0 * slope], axis=-1))


def scratches() -> HeightFieldTile:
    """Grooves one vertex wide, which a grid thinned by two does not have."""
    h = np.zeros((512, 512))
    h[:, 1::32] = -1
    return height_field(h, 0.004, 0.3)


def checks() -> HeightFieldTile:
    """Red and green of equal luminance on a faint displacement."""
    red = np.random.default_rng(4).random((256, 256)) < 0.5
    return height_field(
        fractal(64, 64, 3.0), 4e-4, np.where(red[..., None], [0.8, 0.1, 0.1], [0.1, 0.8, 0.1])
    )


def bright_veil() -> HeightFieldTile:
    """Bright texels transmit a little light."""
    opacity, base = np.ones((64, 64)), np.full((64, 64, 3), 0.005)
    opacity[:, :2], base[:, :2] = 254 / 255, 0.9
    return height_field(np.zeros((4, 4)), 1.0, base, opacity=opacity)


SCENES: dict[str, tuple[HeightFieldTile, dict[str, Any], int]] = {
    # Bounds for Lambert do not hold under a clearcoat: the error was 0.4 with them.
    "clearcoat": (
        height_field(
            fractal(64, 64, 3.0), 2e-5, normal=ripples(0.003), clearcoat=1.0, clearcoat_roughness=0.1
        ),
        {},
        16,
    ),
    # Errors of 0.09, 0.02, 0.01 and 0.007 in plans that ignored what is named.
    "scratches": (scratches(), {}, 8),
    "colors of one brightness": (checks(), {"queries": {"resolution": 256}}, 8),
    "wide light from above": (
        height_field(fractal(64, 64, 1.6), 0.2, 0.05),
        {"queries": {"min_cos": 0.98, "resolution": 64}, "light": {"width": 20.0}},
        64,
    ),
    "bright veil": (bright_veil(), {"queries": {"resolution": 64}, "light": {"width": 0.0}}, 128),
}


@pytest.mark.parametrize("scene", SCENES)
def test_auto_is_all_within_the_tolerance(scene: str) -> None:
    material, options, spp = SCENES[scene]
    job, everything = job_of(material, **options), job_of(material, "all", **options)
    queries = pilot_queries(job, 100_000)
    full, cut = (
        build_estimator(j, plan_effects(j)).estimate(queries, spp, Stream(1, "test", 0))
        for j in (everything, job)
    )
    found = Change.of(full, cut)
    assert 2 * found.rms - found.upper < job.config.effects.tolerance


@pytest.mark.parametrize("mode", ["-parallax", "all,-parallax"])
def test_reference_pictures_leave_out_what_the_user_switches_off(mode: str) -> None:
    """Effects that need it are off, too."""
    job = job_of(height_field(fractal(16, 16, 2.0), 0.1), mode)
    build_estimator(job, reference_plan(job))


def test_a_cap_has_a_positive_bias_bound() -> None:
    """If all products of halves are zero, the pilot found nothing, but rare paths may survive roulette."""
    folder = ROOT / "assets" / "cliff_rock"
    job = job_of(load_material(folder))
    plan = plan_effects(job)
    assert plan.max_depth > 0
    queries = pilot_queries(job, 16_000)
    # With late roulette the cap cuts small parts of many paths, not large parts of few.
    estimator = build_estimator(job, replace(plan, max_depth=0, roulette_depth=10))
    full = estimator.estimate(queries, 32, Stream(9, "test", 0))
    cut = estimator.estimate(queries, 32, Stream(9, "test", 0), limit=plan.max_depth)
    change = float((full.value_a - cut.value_a).mean() / full.value_a.mean())
    # A mean never exceeds a root mean square. Here it is 6e-4.
    assert 0.9 * change <= plan.cap_bias_bound


def test_a_seam_does_not_make_slopes_count_more_than_once() -> None:
    """A normal map with the slopes of its heights adds nothing except at the seam of a cropped tile."""
    big = fractal(256, 256, 3.0)
    slope = height_slopes(HeightGrid(0.2 * big - 0.2, 1.0))[:128, :128]
    grid = HeightGrid.from_map(big[:128, :128], 0.4)
    residual, _ = residual_slopes(slope_normals(slope), grid)
    inner = (slice(16, 112), slice(16, 112))
    total = (height_slopes(grid) + residual)[inner]
    assert np.sum(total * slope[inner]) / np.sum(slope[inner] ** 2) == pytest.approx(1.0, abs=0.05)
