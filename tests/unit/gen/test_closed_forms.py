"""Closed forms against the height fields themselves, by marching rays over the cross-section."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.closed_forms import Groove, Wall

from mbtf_core.directions import from_angles

PAIRS = [((70, 0), (80, 0)), ((35, 10), (50, 200)), ((20, 180), (60, 30)), ((15, 60), (25, 75))]


def profile(field: Any, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the cross-section."""
    z = field.grid.z[0]
    n = len(z)
    return np.interp(x, (np.arange(-n, 2 * n) + 0.5) / n, np.tile(z, 3), period=None)


def seen_point(field: Any, x: float, view: NDArray[np.float64]) -> float:
    """Where the line along `view` through x of the reference plane first meets the height field."""
    d = np.linspace(0.0, field.grid.displacement_range, 20_001)
    at = x - d * view[0] / view[2]
    below = -d <= profile(field, at % 1.0)
    return float(at[np.argmax(below)] % 1.0)


def brute(field: Any, x: float, light: NDArray[np.float64], view: NDArray[np.float64]) -> float:
    """B at x of the reference plane."""
    at = seen_point(field, x, view)
    e = 1e-5
    slope = (profile(field, np.array([at + e])) - profile(field, np.array([at - e])))[0] / (2 * e)
    z = profile(field, np.array([at]))[0]
    rise = np.linspace(1e-4, -z, 5001) if z < -1e-4 else np.zeros(0)
    along = (at + rise * light[0] / light[2]) % 1.0
    if np.any(profile(field, along) > z + rise + 1e-6):
        return 0.0
    return field.albedo / np.pi * max(0.0, (light[2] - slope * light[0]) / np.hypot(1, slope)) / light[2]


@pytest.mark.parametrize(("light", "view"), PAIRS)
def test_groove(light: tuple[float, float], view: tuple[float, float]) -> None:
    groove = Groove(0.4, 0.7)
    omega_i, omega_o = from_angles(*light), from_angles(*view)
    x = (np.arange(400) + 0.5) / 400
    marched = np.array([brute(groove, p, omega_i, omega_o) for p in x])
    formula = groove.value(x, omega_i, omega_o)
    assert np.mean(np.abs(marched - formula) > 1e-3) < 0.02
    assert groove.tile_mean(omega_i, omega_o) == pytest.approx(marched.mean(), abs=5e-3)
    assert groove.tile_mean(omega_i, omega_o) == pytest.approx(
        groove.value((np.arange(100_000) + 0.5) / 1e5, omega_i, omega_o).mean(), abs=2e-5
    )


@pytest.mark.parametrize("elevation", [65.0, 80.0])
def test_wall(elevation: float) -> None:
    wall, up = Wall(32, 30.0, 0.7), np.array([0.0, 0, 1])
    light = from_angles(elevation, 0)
    x = (np.arange(1280) + 0.5) / 1280
    marched = np.mean([brute(wall, p, light, up) for p in x])
    assert wall.tile_mean_from_above(light) == pytest.approx(marched, rel=5e-3)
    with pytest.raises(ValueError, match="too low"):
        wall.tile_mean_from_above(from_angles(20, 0))
