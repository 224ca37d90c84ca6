"""Geometry of the tile: vertices on texel centers, the closing cell, triangles that face up."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core.data.lattice import texel_centers
from mbtf_gen.tile.heights import HeightGrid, grid_faces, grid_vertices

SHAPES = [(4, 6), (1, 1), (1, 5), (5, 1), (3, 3)]


def grid(rows: int, columns: int, seed: int = 0) -> HeightGrid:
    return HeightGrid.from_map(np.random.default_rng(seed).random((rows, columns)), 0.3)


@pytest.mark.parametrize(("rows", "columns"), SHAPES)
def test_vertices_sit_on_texel_centers(rows: int, columns: int) -> None:
    g = grid(rows, columns)
    vertices = grid_vertices(g)
    assert vertices.shape == (rows + 1, columns + 1, 3)
    centers = texel_centers(rows, columns) * (1.0, g.aspect)
    np.testing.assert_allclose(vertices[:-1, :-1, :2], centers, atol=1e-15)
    np.testing.assert_array_equal(vertices[:-1, :-1, 2], g.z)


@pytest.mark.parametrize(("rows", "columns"), SHAPES)
@pytest.mark.parametrize("apron", [(0, 0), (2, 3)])
def test_the_mesh_repeats_after_one_period(rows: int, columns: int, apron: tuple[int, int]) -> None:
    g = grid(rows, columns)
    vertices = grid_vertices(g, apron)
    assert vertices.shape == (rows + 1 + 2 * apron[0], columns + 1 + 2 * apron[1], 3)
    np.testing.assert_allclose(
        vertices[:, columns:] - vertices[:, :-columns],
        [1.0, 0.0, 0.0] + 0 * vertices[:, columns:],
        atol=1e-14,
    )
    np.testing.assert_allclose(
        vertices[rows:] - vertices[:-rows], [0.0, -g.aspect, 0.0] + 0 * vertices[rows:], atol=1e-14
    )
    np.testing.assert_array_equal(
        grid_vertices(g), vertices[apron[0] : apron[0] + rows + 1, apron[1] : apron[1] + columns + 1]
    )


def test_triangles_face_up_and_share_their_edges() -> None:
    g = grid(4, 6)
    flat = grid_vertices(g).reshape(-1, 3)
    faces = grid_faces(5, 7)
    assert faces.shape == (2 * 4 * 6, 3)
    corners = flat[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # Twice the area seen from above: half a cell each.
    np.testing.assert_allclose(normals[:, 2], (1 / 6) * (g.aspect / 4))
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert set(counts.tolist()) == {1, 2}
    assert np.sum(counts == 1) == 2 * (4 + 6)
