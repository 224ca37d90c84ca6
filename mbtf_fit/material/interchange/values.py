"""Values of a neural material that its maps are fitted to and compared with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch.quasirandom import SobolEngine

from mbtf_core.data.lattice import sigma_of_level
from mbtf_core.directions import from_projected_disk, normalize
from mbtf_fit.material.material import Material

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
# Positions of the footprint of the whole tile.
_POSITIONS = 16
# Tangents of the angles between half vectors and the normal, around highlights.
_HIGHLIGHT = (0.01, 0.6)
# Iterations of the search for a point that a view sees.
_ITERATIONS = 4


@contextmanager
def one_thread_each() -> Iterator[int]:
    """PyTorch with one thread per operation, as small ones lose time waiting. Yields the usual number."""
    count = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield count
    finally:
        torch.set_num_threads(count)


def least_cosine(material: Material) -> float:
    """Least cosine of the directions of the material's data."""
    return float(material.description["data"].get("min_cos", 0.1))


def _sobol(dimensions: int, count: int, seed: int) -> F64:
    """Scrambled points (count, dimensions) of Sobol's sequence."""
    engine = SobolEngine(dimensions, scramble=True, seed=seed)
    return np.asarray(engine.draw(count, dtype=torch.float64).numpy(), np.float64)


def direction_pairs(count: int, least: float, seed: int = 0) -> tuple[F64, F64]:
    """Lights and views (count, 3), cosine-weighted, with cosines of at least `least`."""
    points = _sobol(4, count, seed)
    radius = np.sqrt((1.0 - least**2) * points[:, [0, 2]])
    angle = 2.0 * np.pi * points[:, [1, 3]]
    disk = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    omega = from_projected_disk(disk)
    return np.asarray(omega[:, 0], np.float64), np.asarray(omega[:, 1], np.float64)


def steep_views(count: int, sine: float = 0.7, seed: int = 0) -> F64:
    """Views (count, 3), cosine-weighted, whose sine to the normal is at most `sine`; 0.7 is that of 45°.

    Maps have no parallax. Steep views show the same points of a surface, wherever its heights are.
    """
    return inclined(direction_pairs(count, 0.0, seed)[1], sine)


def inclined(omega: F64, factor: float) -> F64:
    """Directions (..., 3) whose sines to the normal are scaled."""
    return from_projected_disk(factor * omega[..., :2])


def followed(material: Material, u: F64, views: F64) -> F64:
    """Positions (n, m, 2) at which views (m, 3) see the points that the normal view sees at `u` (n, 2).

    The offset leads from the reference plane to the point that is seen. Without one they are `u`.
    """
    n, m = len(u), len(views)
    size = np.array([1.0, material.lattice.aspect])
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (n, 3))
    seen = np.repeat(u + material.offset(u, up) / size, m, 0)
    at, all_views = np.repeat(u, m, 0), np.tile(views, (n, 1))
    for _ in range(_ITERATIONS):
        at = seen - material.offset(at, all_views) / size
    return at.reshape(n, m, 2)


def highlight_pairs(slopes: F32, views: F64, least: float) -> F64:
    """Lights whose half vectors with given views are close to the normals of texels.

    The half vectors' angles to the normal are log-uniform in their tangent, so that some are within the
    highlight of every roughness. Lights below the least cosine are raised to it.

    Parameters
    ----------
    slopes : (n, 2) array
        Slopes of the normals.
    views : (k, 3) array
    least : float
        Least cosine of the lights.

    Returns
    -------
    (n, k, 3) array
    """
    points = _sobol(2, len(views), 2)
    low, high = np.log(_HIGHLIGHT)
    tangent, angle = np.exp(low + (high - low) * points[:, 0]), 2.0 * np.pi * points[:, 1]
    normal = normalize(np.concatenate([-slopes, np.ones((len(slopes), 1))], 1))
    # An orthonormal basis of each normal, whose z is positive (Duff et al. 2017).
    x, y, z = normal.T
    a = -1.0 / (1.0 + z)
    first = np.stack([1.0 + x * x * a, x * y * a, -x], 1)
    second = np.stack([x * y * a, 1.0 + y * y * a, -y], 1)
    along, across = (tangent * np.cos(angle))[:, None], (tangent * np.sin(angle))[:, None]
    half = normalize(normal[:, None] + along * first[:, None] + across * second[:, None])
    light = 2.0 * (views * half).sum(-1, keepdims=True) * half - views
    light[..., 2] = np.maximum(light[..., 2], 0.0)
    flat = np.linalg.norm(light[..., :2], axis=-1)
    low_light = light[..., 2] < least * np.hypot(flat, light[..., 2])
    light[..., 2] = np.where(low_light, flat * least / np.sqrt(1.0 - least**2), light[..., 2])
    return normalize(light)


def texel_values(material: Material, level: int, u: F64, omega_i: F64, omega_o: F64) -> tuple[F32, F32]:
    """Values of a material at positions for pairs of directions, and what the views meet of it.

    Parameters
    ----------
    u : (n, 2) or (n, k, 2) array
        Positions, uv.
    omega_i, omega_o : (k, 3) or (n, k, 3) arrays

    Returns
    -------
    values : (n, k, 3) array
        In 1/sr, with the footprint of the level.
    opacity : (n, k) array
        One less the transmittance.
    """
    n, k = len(u), omega_i.shape[-2]
    sigma = np.full(n * k, float(sigma_of_level(level)), np.float32)

    def rows(array: F64) -> F32:
        # A copy: PyTorch warns of memory that cannot be written.
        size = array.shape[-1]
        return np.array(np.broadcast_to(array, (n, k, size)), np.float32).reshape(-1, size)

    at, light, view = rows(u if u.ndim == 3 else u[:, None]), rows(omega_i), rows(omega_o)
    values = material.evaluate(at, sigma, light, view).reshape(n, k, 3)
    if material.transmittance is None:
        return values, np.ones((n, k), np.float32)
    return values, 1.0 - material.transmittance.evaluate(at, sigma, view).reshape(n, k)


def tile_means(material: Material, omega_i: F64, omega_o: F64) -> F64:
    """Mean reflectance (n, 3) of the tile by the neural material: that of the footprint of the whole tile, at
    some positions."""
    n = len(omega_i)
    side = round(math.sqrt(_POSITIONS))
    grid = (np.stack(np.meshgrid(*2 * [np.arange(side)]), -1).reshape(-1, 2) + 0.5) / side
    u = np.repeat(grid, n, 0)
    sigma = np.full(len(u), float(sigma_of_level(0)))
    light, view = (np.tile(omega, (len(grid), 1)) for omega in (omega_i, omega_o))
    value = material.evaluate(u, sigma, light, view)
    return np.asarray(value.reshape(len(grid), n, 3).mean(0), np.float64)
