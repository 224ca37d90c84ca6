"""Directions and exposure; the camera's queries against what a pinhole sees, from finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core.color import (
    ALBEDO_EXPOSURE,
    auto_exposure,
    brightness,
    chosen_exposure,
    srgb_to_linear,
    to_display,
    white_of,
)
from mbtf_core.directions import from_angles, from_projected_disk
from mbtf_core.pictures import Camera

UP = np.array([0.0, 0.0, 1.0])
CAMERA = Camera(
    elevation=30.0, azimuth=40.0, tiles_across=0.3, target=(0.5, 0.45), rows=61, columns=81, field_of_view=25
)


@pytest.mark.parametrize("aspect", [1.0, 0.5, 3.0])
def test_footprint_is_half_the_geometric_mean_of_the_pixel(aspect: float) -> None:
    q = CAMERA.queries(UP, aspect)
    # Positions in tile widths; steps between pixels never leave half a tile.
    x = q.u.astype(np.float64) * (1.0, aspect)
    period = np.array([1.0, aspect])

    def step(axis: int) -> np.ndarray:
        full = np.roll(x, -1, axis) - np.roll(x, 1, axis)
        return 0.5 * (full - period * np.round(full / period))[1:-1, 1:-1]

    down, right = step(0), step(1)
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    np.testing.assert_allclose(q.sigma[1:-1, 1:-1], 0.5 * np.sqrt(area), rtol=2e-3)


@pytest.mark.parametrize("aspect", [1.0, 0.5, 3.0])
def test_views_point_from_the_plane_to_the_camera(aspect: float) -> None:
    q = CAMERA.queries(UP, aspect)
    # Going back along ω_o from the height of the camera meets the plane at u, up to whole periods.
    omega = q.omega_o.astype(np.float64)
    x = CAMERA.position[:2] - CAMERA.position[2] * omega[..., :2] / omega[..., 2:]
    difference = x / (1.0, aspect) - q.u
    np.testing.assert_allclose(difference, np.round(difference), atol=1e-5)
    # The middle pixel looks at the target, from the stated direction; there the picture is that wide.
    np.testing.assert_allclose(omega[30, 40], from_angles(30.0, 40.0), atol=1e-6)
    np.testing.assert_allclose(x[30, 40], CAMERA.target, atol=1e-5)
    assert np.linalg.norm(x[30, 80] - x[30, 0]) * 81 / 80 == pytest.approx(CAMERA.tiles_across, rel=1e-2)


def test_axes() -> None:
    """Azimuth counts from +u towards +v."""
    assert from_angles(0, 0) == pytest.approx([1, 0, 0], abs=1e-15)
    assert from_angles(0, 90) == pytest.approx([0, 1, 0], abs=1e-15)
    assert from_angles([90, 90], [10, 200]) == pytest.approx(np.array([[0, 0, 1], [0, 0, 1]]), abs=1e-15)
    assert from_angles(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3, 3)
    assert np.linalg.norm(from_angles(33.0, 123.0)) == pytest.approx(1.0)
    # Grazing elevations keep their precision.
    assert from_angles(1e-6, 45.0)[2] == pytest.approx(np.radians(1e-6), rel=1e-9)


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.99, 1.0])
def test_projected_disk(radius: float) -> None:
    omega = from_projected_disk([radius * 0.6, radius * -0.8])
    assert omega[:2] == pytest.approx([radius * 0.6, radius * -0.8])
    assert np.linalg.norm(omega) == pytest.approx(1.0)
    # Rounding beyond the disk gives no NaN.
    assert from_projected_disk([1.0 + 1e-12, 0.0])[2] == 0.0


RAMP = np.repeat(np.linspace(0, 1, 1001)[:, None], 3, axis=1).reshape(-1, 1, 3)


def test_the_automatic_exposure_shows_bright_values_as_four_fifths_of_white() -> None:
    for pictures, level in (([RAMP], 0.95), ([RAMP, 100 * RAMP, 3 * RAMP], 2.85)):
        found = auto_exposure(map(brightness, pictures))
        assert white_of(found) == pytest.approx(level / 0.8, rel=0.004)
    assert auto_exposure([brightness(0 * RAMP)]) == 0.0


def test_the_default_exposure_keeps_albedos() -> None:
    """Lambert: albedo/π under unit irradiance."""
    for albedo in (0.03, 0.5, 0.9):
        shown = to_display(np.full(3, albedo / np.pi), chosen_exposure(ALBEDO_EXPOSURE, [7.0]))
        np.testing.assert_allclose(srgb_to_linear(shown / 255), albedo, rtol=0.02)


def test_a_stop_is_a_factor_of_two() -> None:
    np.testing.assert_array_equal(to_display(RAMP, 1.0), to_display(2 * RAMP, 0.0))
    assert to_display(np.array([[0.0, 0.25, 9.0]]), 2.0).tolist() == [[0, 255, 255]]
