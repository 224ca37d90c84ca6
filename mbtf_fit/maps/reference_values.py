"""Values of a neural material that maps are fitted to and compared with, and their lights and views."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.quasirandom import SobolEngine

from mbtf_core.data.lattice import sigma_of_level
from mbtf_core.directions import from_projected_disk, normalize
from mbtf_fit.material.format import DEFAULT_MIN_COS
from mbtf_fit.material.material import Material

F64 = NDArray[np.float64]
# Positions along a side, for the footprint of the whole tile.
_SIDE = 4
# Tangents of the angles between half vectors and the normal, around highlights.
_HIGHLIGHT = (0.01, 0.6)
# Iterations of the search for a point that a view sees.
_ITERATIONS = 4
# Least divisor of values.
LEAST_OPACITY = 0.05


def least_cosine(material: Material) -> float:
    """Least cosine of the directions of the material's data."""
    return float(material.description["data"].get("min_cos", DEFAULT_MIN_COS))


def _sobol(dimensions: int, count: int, seed: int) -> F64:
    """Scrambled points (count, dimensions) of Sobol's sequence."""
    engine = SobolEngine(dimensions, scramble=True, seed=seed)
    return np.asarray(engine.draw(count, dtype=torch.float64).numpy(), np.float64)


def direction_pairs(count: int, least: float, seed: int = 0) -> tuple[F64, F64]:
    """Lights and views (count, 3), cosine-weighted, with cosines of at least `least`."""
    points = _sobol(4, count, seed)
    radius = np.sqrt((1.0 - least**2) * points[:, [0, 2]])
    angle = 2.0 * np.pi * points[:, [1, 3]]
    omega = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    return omega[:, 0], omega[:, 1]


def steep_views(count: int, sine: float = 0.7, seed: int = 0) -> F64:
    """Views (count, 3), cosine-weighted, whose sine to the normal is at most `sine`; 0.7 is that of 45°.

    Maps have no parallax. Steep views show the same points of a surface, wherever its heights are.
    """
    return from_projected_disk(sine * direction_pairs(count, 0.0, seed)[1][:, :2])


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


def highlight_pairs(slopes: F64, views: F64, least: float) -> F64:
    """Lights (n, k, 3) whose half vectors with views (k, 3) are close to the normals of slopes (n, 2).

    The half vectors' angles to the normal are log-uniform in their tangent, so that some are within the
    highlight of every roughness. Lights whose cosine is below `least` are raised to it.
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


def texel_values(material: Material, level: int, u: F64, omega_i: F64, omega_o: F64) -> tuple[F64, F64]:
    """Values of a material with the footprint of a level, and what the views meet of it.

    Parameters
    ----------
    material : Material
    level : int
    u : (n, k, 2), positions, uv
    omega_i, omega_o : (k, 3) or (n, k, 3) arrays

    Returns
    -------
    values : (n, k, 3) array
        In 1/sr.
    opacity : (n, k) array
        One less the transmittance.
    """
    n, k = u.shape[:2]
    light, view = (np.broadcast_to(omega, (n, k, 3)).reshape(-1, 3) for omega in (omega_i, omega_o))
    at, sigma = u.reshape(-1, 2), np.full(n * k, float(sigma_of_level(level)))
    values = material.evaluate(at, sigma, light, view).reshape(n, k, 3).astype(np.float64)
    if material.transmittance is None:
        return values, np.ones((n, k))
    return values, 1.0 - material.transmittance.evaluate(at, sigma, view).reshape(n, k).astype(np.float64)


def solid_values(material: Material, level: int, u: F64, omega_i: F64, omega_o: F64) -> tuple[Tensor, F64]:
    """Values (n, 3, k) of what the views meet, and the most (n,) that one meets; see :func:`texel_values`."""
    values, opacity = texel_values(material, level, u, omega_i, omega_o)
    solid = values / np.maximum(opacity, LEAST_OPACITY)[..., None]
    return torch.from_numpy(solid).float().transpose(1, 2).contiguous(), opacity.max(1)


def tile_means(material: Material, omega_i: F64, omega_o: F64) -> F64:
    """Mean reflectance (n, 3) of the tile for pairs of directions: that of the footprint of the whole tile,
    at some positions."""
    u = (np.stack(np.meshgrid(*2 * [np.arange(_SIDE)]), -1).reshape(-1, 1, 2) + 0.5) / _SIDE
    values, _ = texel_values(material, 0, np.tile(u, (1, len(omega_i), 1)), omega_i, omega_o)
    mean: F64 = values.mean(0)
    return mean
