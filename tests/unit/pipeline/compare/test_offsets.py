"""Traced offsets match plane geometry."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core.directions import from_angles
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.tile.heights import HeightGrid
from mbtf_pipeline.compare.offsets import towards_view, traced_offset
from mbtf_pipeline.recipe import SceneView

DEPTH = 0.05


@pytest.fixture(scope="module")
def plane_below() -> object:
    """A plane at depth 0.05 with one peak that touches the reference plane, twice as high as wide."""
    load_mitsuba()
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    heights = np.full((64, 32), -DEPTH)
    heights[60, 2] = 0.0
    grid = HeightGrid.from_map(heights, 1.0, 2.0)
    tile = build_scene(grid, {"type": "diffuse"})
    return Estimator(tile, None, Transport())


@pytest.mark.parametrize(("elevation", "azimuth"), [(30, 0), (30, 135), (60, -90), (90, 0), (20, 250)])
def test_a_plane_below_is_displaced(plane_below: object, elevation: float, azimuth: float) -> None:
    u = np.array([[0.5, 0.5], [0.7, 0.4], [0.3, 0.6]], np.float32)
    found = traced_offset(plane_below, u, from_angles(elevation, azimuth))  # type: ignore[arg-type]
    distance = DEPTH / np.tan(np.radians(elevation))
    expected = -distance * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    np.testing.assert_allclose(found, np.broadcast_to(expected, (3, 2)), atol=2e-6)
    along = towards_view(found, SceneView(elevation=elevation, azimuth=azimuth))
    np.testing.assert_allclose(along, -distance, atol=2e-6)


def test_a_peak_at_the_plane_is_not_displaced(plane_below: object) -> None:
    # Texel centers lie at ((i+½)/W, 1-(j+½)/H).
    u = np.array([[2.5 / 32, 1 - 60.5 / 64]], np.float32)
    found = traced_offset(plane_below, u, from_angles(90, 0))  # type: ignore[arg-type]
    np.testing.assert_allclose(found, 0, atol=1e-6)
    slanted = traced_offset(plane_below, u, from_angles(30, 0))  # type: ignore[arg-type]
    assert np.abs(slanted).max() < 1e-4
