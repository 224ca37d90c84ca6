"""Periodic random patterns that come out the same on every machine: hashed numbers, noise, blends.

Fields are arrays (H, W) over the tile; u and v have period 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Field = NDArray[np.float64]
Indices = NDArray[np.int64]

SIZE = 256


def uniform(*keys: ArrayLike) -> Field:
    """Numbers in [0, 1) by a 64-bit hash of integer keys, which are broadcast against each other."""
    state: NDArray[np.uint64] = np.full(1, 0x9E3779B97F4A7C15, np.uint64)
    for key in keys:
        state = state ^ np.asarray(key).astype(np.int64).astype(np.uint64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            state = (state ^ (state >> np.uint64(shift))) * np.uint64(factor)
        state = state ^ (state >> np.uint64(31))
    numbers: Field = (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return numbers


def smooth(low: float, high: float, x: Field) -> Field:
    """0 below `low`, 1 above `high`, with zero slope at both ends; `low` > `high` falls instead of rising."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def mix(a: ArrayLike, b: ArrayLike, weight: Field) -> Field:
    """a where the weight is 0, b where it is 1; colors have a trailing axis of 3."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    w = weight[..., None] if (3,) in (a.shape[-1:], b.shape[-1:]) else weight
    return np.asarray(a + (b - a) * w)


def noise(u: Field, v: Field, cells: tuple[int, int], seed: int) -> Field:
    """Gradient noise (Perlin 1985) of period 1 in u and v with `cells` lattice cells each way, about ±0.7."""
    x, y = u * cells[0], v * cells[1]
    i, j = np.floor(x), np.floor(y)
    fx, fy = x - i, y - j

    def corner(a: int, b: int) -> Field:
        angle = 2.0 * np.pi * uniform(seed, (i + a) % cells[0], (j + b) % cells[1])
        return np.asarray(np.cos(angle) * (fx - a) + np.sin(angle) * (fy - b))

    wx, wy = (t * t * t * (t * (t * 6.0 - 15.0) + 10.0) for t in (fx, fy))
    near = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * wx
    far = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * wx
    return np.asarray(near + (far - near) * wy)


def layered(u: Field, v: Field, cells: int, octaves: int, seed: int) -> Field:
    """Sum of noises, each of twice the frequency and half the size of the one before."""
    layers = [noise(u, v, (cells << o, cells << o), seed + 101 * o) * 0.5**o for o in range(octaves)]
    return np.asarray(sum(layers))


def lattice() -> tuple[Field, Field]:
    """u and v (H, W) of the texel centers."""
    u, v = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, 1.0 - (np.arange(SIZE) + 0.5) / SIZE)
    return u, v
