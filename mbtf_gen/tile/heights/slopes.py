"""Slopes of heights and of normal maps, and the residual: the slopes of a normal map that the mesh lacks.

Slopes are rises per length along x = u and y = a·v, both in tile widths; row 0 is the side ``v → 1``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.geometry import mesh_slopes
from mbtf_core.images.resample import resample
from mbtf_gen.config.generator import NormalMode
from mbtf_gen.tile.heights.grid import HeightGrid

# Smallest z, a slope of 20, that 8-bit maps resolve.
_SMALLEST_Z = 0.05


def height_slopes(grid: HeightGrid) -> NDArray[np.float64]:
    """Slopes (H, W, 2) of the mesh at its vertices, by central differences over the period."""
    return mesh_slopes(grid.z, grid.aspect)


def normal_slopes(normal: NDArray[np.floating[Any]], smallest_z: float = _SMALLEST_Z) -> NDArray[np.float64]:
    """Slopes (h, w, 2) of unit normals (h, w, 3) with y along v, z clamped to at least `smallest_z`."""
    n = normal.astype(np.float64)
    return -n[..., :2] / np.maximum(n[..., 2:], smallest_z)


def carried_share(normal: NDArray[np.float64], heights: NDArray[np.float64]) -> float:
    """Share c ≥ 0 of the mesh's slopes `heights` (H, W, 2) that a normal map's `normal` (H, W, 2) repeats:
    the least-squares fit of c·heights to normal."""
    power = float(np.sum(heights**2))
    return max(0.0, float(np.sum(heights * normal)) / power) if power > 0 else 0.0


def residual_slopes(
    normal: NDArray[np.float32], grid: HeightGrid, mode: NormalMode = "residual"
) -> tuple[NDArray[np.float64], float]:
    """Slopes to add to the mesh's own, and the share c of the mesh's slopes that the map repeats.

    Parameters
    ----------
    normal : (h, w, 3) float array
        Unit vectors, y along v.
    grid : HeightGrid
        Heights of the mesh.
    mode : {"residual", "absolute", "off"}
        ``residual``: slopes of the map less ``min(c, 1)`` times those of the mesh, so that slopes of both
        count once and displacement beyond the map's stays. ``absolute``: the map's slopes in place of the
        mesh's.

    Returns
    -------
    slopes : (h, w, 2) float64 array
        Slopes at the texels of the map.
    share : float
        c ≥ 0.
    """
    rows, columns = normal.shape[:2]
    stated = normal_slopes(normal)
    carried = np.asarray(resample(height_slopes(grid), rows, columns), np.float64)
    # Heights need not tile: the cliff at a seam is no slope that the map could repeat.
    edge = [-(-2 * size // have) for size, have in zip((rows, columns), grid.z.shape, strict=True)]
    if min(rows - 2 * edge[0], columns - 2 * edge[1]) < 1:
        edge = [0, 0]
    inner = (slice(edge[0], rows - edge[0]), slice(edge[1], columns - edge[1]))
    share = carried_share(stated[inner], carried[inner])
    taken = 1.0 if mode == "absolute" else min(share, 1.0)
    return stated - taken * carried, share
