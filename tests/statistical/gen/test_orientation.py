"""u and v are neither flipped, swapped nor shifted between heights, maps, queries and pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import (
    DIRECT,
    HeightGrid,
    LightKernel,
    Transport,
    build_scene,
    direction,
    estimate,
    flat,
    queries,
)

from mbtf_core.data.lattice import texel_centers
from mbtf_core.pictures import Camera

ROWS, COLUMNS = 4, 8
ASPECT = ROWS / COLUMNS
UP = [0.0, 0.0, 1.0]


def color_map() -> NDArray[np.float32]:
    return np.random.default_rng(2).uniform(0.1, 0.9, (ROWS, COLUMNS, 3)).astype(np.float32)


def textured(pixels: NDArray[np.float32]) -> dict[str, Any]:
    from mbtf_gen.tile.reflectance import plugin_dictionary

    return plugin_dictionary({"base_color": pixels})


def test_color_at_texel_centers_is_the_texel() -> None:
    pixels = color_map()
    u = texel_centers(ROWS, COLUMNS).reshape(-1, 2)
    q = queries(u, 1e-6, UP, UP, len(u))
    e = estimate(flat(ASPECT), textured(pixels), LightKernel(0.0), q, 2)
    np.testing.assert_allclose(e.value_a * np.pi, pixels.reshape(-1, 3), atol=2e-4)


def test_color_between_texels_wraps_around() -> None:
    pixels = color_map()
    # On the tile's corner four texels meet: those of the map's four corners.
    e = estimate(flat(ASPECT), textured(pixels), LightKernel(0.0), queries([0.0, 0.0], 1e-6, UP, UP, 1), 2)
    corner = pixels[[0, 0, -1, -1], [0, -1, 0, -1]].mean(axis=0)
    np.testing.assert_allclose(e.value_a[0] * np.pi, corner, atol=2e-4)


@pytest.mark.parametrize(("azimuth", "axis", "sign"), [(0, 0, -1), (180, 0, 1), (90, 1, -1), (270, 1, 1)])
def test_sunk_texture_is_seen_displaced(azimuth: float, axis: int, sign: int) -> None:
    """A plane sunk by d under one high texel: the texture is looked up at u - d·ω_xy/ω_z."""
    rows = columns = 32
    depth = 0.25
    heights = np.full((rows, columns), -depth)
    # One peak keeps the reference plane up; queries stay far from it and from its shadow.
    heights[0, 0] = 0.0
    ramp = np.linspace(0.1, 0.9, 32, dtype=np.float32)
    pixels = np.broadcast_to((ramp if axis == 0 else ramp[::-1, None])[..., None], (rows, columns, 3)).copy()
    omega_o = direction(60, azimuth)
    u = np.array([0.5, 0.5]) - 0.5 * depth * omega_o[:2] / omega_o[2] * -1.0
    grid = HeightGrid.from_map(heights, 1.0)
    e = estimate(
        grid, textured(pixels), LightKernel(0.0), queries(u, 1e-6, UP, omega_o, 1), 2, transport=DIRECT
    )
    seen = u[axis] - depth * omega_o[axis] / omega_o[2]
    expected = np.interp(seen, (np.arange(32) + 0.5) / 32, ramp)
    assert e.value_a[0, 0] * np.pi == pytest.approx(expected, abs=2e-3)
    assert np.sign(seen - u[axis]) == sign


def test_pixel_kind_and_query_kind_agree_from_above() -> None:
    """At normal incidence both kinds of picture of an asymmetric textured height field agree."""
    from support.scenes import rocks
    from support.significance import aggregate_test

    from mbtf_gen.pictures.reference import render_reference
    from mbtf_gen.render.estimator import Estimator

    estimator = Estimator(build_scene(rocks(32), textured(color_map())), LightKernel(1.0), Transport())
    camera = Camera(90.0, -90.0, 1.5, rows=40, columns=40, field_of_view=1.0)
    pair = [
        render_reference(estimator, camera, direction(50, 20), kind=k, spp=64) for k in ("query", "pixel")
    ]
    flat_halves = [h.reshape(-1, 3) for image in pair for h in (image.value_a, image.value_b)]
    result = aggregate_test(*flat_halves)
    assert result.p_value > 1e-3, str(result)
    # The same pictures with one turned upside down differ significantly.
    turned = (h.reshape(40, 40, 3)[::-1].reshape(-1, 3) for h in flat_halves[2:])
    assert aggregate_test(*flat_halves[:2], *turned).p_value < 1e-6
