"""Twisted wool: thick cords of three plies wound about each other, one of them dyed."""

from __future__ import annotations

import numpy as np

from .fibers import Surface, strands, stray_fibers
from .noise import Field, lattice, layered, mix, noise, smooth, uniform
from .tile import Material

# Cords from v = 0 up: share of the tile, and turns of the twist per tile. Nothing repeats within a tile.
SHARES = np.array([1.00, 1.20, 0.85, 1.10])
TURNS = (2, 2, 3, 2)
PLIES = 3
FIBRES = 28  # around a ply

CREAM = (0.83, 0.77, 0.65)
# The third ply of each cord; the other two are natural.
DYES = np.array([(0.16, 0.31, 0.42), (0.44, 0.45, 0.45), (0.25, 0.40, 0.46), (0.13, 0.25, 0.37)])


def cords(u: Field, v: Field) -> Surface:
    """Cords along u; tube number = cord · PLIES + ply."""
    shares = SHARES / SHARES.sum()
    surface = Surface.ground(0.012 * layered(u, v, 24, 2, 60) - 0.01)
    for cord, share in enumerate(shares):
        half = 0.5 * share
        line = np.full_like(u, (cord + 0.5) / len(shares))
        bend, swell, slip = (noise(u, line, (n, len(shares)), 61 + n) for n in (3, 4, 5))
        across = (v - shares[:cord].sum() - half - 0.010 * bend + 0.5) % 1.0 - 0.5
        reach, thick = 0.50 * half, 0.56 * half * (1.0 + 0.14 * swell)
        for ply in range(PLIES):
            turn = 2.0 * np.pi * (TURNS[cord] * u + uniform(66, cord) + 0.05 * slip + ply / PLIES)
            slope = -2.0 * np.pi * TURNS[cord] * reach * np.sin(turn)
            # Where the ply runs aslant, its cut along v is wider than itself.
            wide = thick * np.sqrt(1.0 + 0.5 * slope**2)
            offset = across - reach * np.cos(turn)
            x = np.clip(offset / wide, -1.0, 1.0)
            z = 0.62 * reach * np.sin(turn) + 0.95 * thick * np.sqrt(1.0 - x * x)
            surface = surface.with_tube(cord * PLIES + ply, offset, wide, z)
    return surface


def twisted_wool() -> Material:
    """Cream wool with a dyed ply in every cord."""
    u, v = lattice()
    surface = cords(u, v)
    bed = surface.tube < 0
    tube = np.maximum(surface.tube, 0)

    # Fibers are spun the other way than plies are wound, and so lie nearly along the cord.
    around = surface.angle / (2.0 * np.pi) - 2.0 * u + 0.37 * tube
    relief, tone = strands(around, u, FIBRES, 6, 70)
    upright = np.where(bed, 0.6, np.cos(surface.angle))
    stray = stray_fibers(u, v, 60, 71)
    lint = layered(u, v, 56, 2, 72)
    height = surface.z + 0.0100 * relief * np.sqrt(upright) + 0.0022 * lint + 0.0030 * stray

    color = np.where((tube % PLIES == PLIES - 1)[..., None], DYES[tube // PLIES], CREAM)
    color = color * (0.76 + 0.22 * relief + 0.34 * (tone - 0.5) + 0.10 * lint)[..., None]
    color = mix(color, (0.80, 0.77, 0.70), 0.30 * smooth(0.80, 1.0, tone))
    color = mix(color, 0.6 * color + (0.32, 0.31, 0.28), 0.45 * stray)
    color = np.where(bed[..., None], 0.6 * color, color)

    roughness = 0.86 - 0.12 * relief + 0.06 * lint
    return Material(height, np.minimum(color, 0.92), roughness, index=1.55)
