"""The displaced meshes that fitted materials are compared with have the height field of the data set."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.scripts import benchmark_module

from mbtf_gen.tile.heights.grid import HeightGrid, tile_mesh


@pytest.fixture(scope="module")
def meshes() -> Any:
    """The benchmark's module."""
    return benchmark_module("curved_meshes")


def crosses(place: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (place[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("tiles", [(3.0, 6.0), (3.0, -6.0)], ids=["upright", "mirrored"])
def test_a_displaced_plane_is_the_tiles_own_mesh(meshes: Any, tiles: tuple[float, float]) -> None:
    """Rough to the single texel: heights that are looked up between vertices give gentler slopes."""
    grid = HeightGrid.from_map(np.random.default_rng(3).random((40, 20)), 0.05)
    plane = meshes.load_object(None, tiles)
    found = meshes.displaced(plane, grid)
    # Stretched back to tile widths along both sides; y is up.
    side = plane.place[:, 0].max() - plane.place[:, 0].min()
    stretch = np.array([abs(tiles[0]) / side, 1 / found.size[0], abs(tiles[1]) / side])
    cross = crosses(found.place * stretch, found.faces)
    # Along the border triangles are squashed to nothing; none is turned over.
    assert (cross[:, 1] > -1e-9).all()
    middle = found.uv[found.faces].mean(1)
    whole = (np.floor(middle / (1.0, grid.aspect)) == (1.0, -2.0 if tiles[1] > 0 else 1.0)).all(1)
    assert abs(cross[:, 1].sum() / 2 / abs(tiles[0] * tiles[1]) - 1) < 5e-3
    tile = tile_mesh(grid)
    wanted = crosses(np.asarray(tile.vertices), np.asarray(tile.faces))
    inner = cross[whole]
    assert len(inner) == len(wanted)
    assert (inner[:, 1] > 0).all()
    slopes = np.sort(np.hypot(inner[:, 0], inner[:, 2]) / inner[:, 1])
    np.testing.assert_allclose(slopes, np.sort(np.hypot(*wanted.T[:2]) / wanted[:, 2]), rtol=1e-3, atol=1e-4)


def test_nothing_gapes_where_texture_coordinates_end(meshes: Any) -> None:
    """Two halves of a square with coordinates of their own; flat, they cover it, and no more than that."""
    square = meshes.load_object(None, (3.0, 3.0))
    right = square.place[square.faces].mean(1)[:, 0] > 0
    count = len(square.place)
    faces = np.where(right[:, None], square.faces + count, square.faces)
    uv = np.concatenate([square.uv, square.uv[:, ::-1] + 0.37])
    twice = [np.concatenate([a, a]) for a in (square.place, square.normal)]
    cut = meshes.Surface(*twice, uv, np.concatenate([square.size, square.size]), faces)
    found = meshes.displaced(cut, HeightGrid(np.zeros((16, 16)), 1.0))
    area = np.linalg.norm(crosses(found.place, found.faces), axis=1).sum() / 2
    assert area == pytest.approx(2.0, rel=1e-3)
