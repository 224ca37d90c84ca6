"""Slopes of heights and normal maps, and the residual of a normal map that the mesh lacks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.height_maps import slope_normals

from mbtf_gen.tile.heights import HeightGrid, height_slopes, residual_slopes

F64 = NDArray[np.float64]


def waves(rows: int, columns: int, amplitude: float = 0.01, along: int = 3, up: int = 2) -> tuple[F64, F64]:
    """Heights of a sum of sines with row 0 at y = aspect, and their slopes by the derivative."""
    aspect = rows / columns
    x = ((np.arange(columns) + 0.5) / columns)[None, :]
    y = (aspect * (1 - (np.arange(rows) + 0.5) / rows))[:, None]
    kx, ky = 2 * np.pi * along, 2 * np.pi * up / aspect
    z = amplitude * (np.sin(kx * x) + np.sin(ky * y + 0.3))
    slopes = np.stack(
        np.broadcast_arrays(amplitude * kx * np.cos(kx * x), amplitude * ky * np.cos(ky * y + 0.3)), axis=-1
    )
    return z, slopes


def normals(slopes: F64) -> NDArray[np.float32]:
    return slope_normals(slopes).astype(np.float32)


@pytest.mark.parametrize("strength", [0.0, 0.002])
@pytest.mark.parametrize("factor", [0.3, 1.0, 5.0])
def test_a_map_that_repeats_the_heights_leaves_what_they_lack(factor: float, strength: float) -> None:
    """Mesh and residual give the map's slopes once; exaggerated heights leave detail alone."""
    z, slopes = waves(128, 128)
    _, detail = waves(128, 128, strength, along=11, up=9)
    grid = HeightGrid.from_map(z, factor)
    residual, share = residual_slopes(normals(slopes + detail), grid)
    assert share == pytest.approx(1 / factor, rel=0.05)
    np.testing.assert_allclose(residual, detail + max(0.0, 1.0 - factor) * slopes, atol=0.02)


def test_absolute_puts_the_map_in_place_of_the_mesh() -> None:
    z, _ = waves(64, 64)
    _, other = waves(64, 64, 0.003, along=5, up=4)
    grid = HeightGrid.from_map(z, 1.0)
    residual, _ = residual_slopes(normals(other), grid, "absolute")
    np.testing.assert_allclose(height_slopes(grid) + residual, other, atol=1e-5)
