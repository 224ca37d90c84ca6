"""Two metals: hammered copper below a lacquer, and brushed aluminum, whose lobe is anisotropic."""

from __future__ import annotations

import numpy as np

from .noise import Field, lattice, layered, mix, noise, smooth, uniform
from .tile import Material


def dents(u: Field, v: Field, cells: int, seed: int) -> tuple[Field, Field]:
    """(depth in [0, 1], number) of the deepest of the bowls that a hammer left at each point.

    One blow falls into each cell of a grid, at a random point.
    """
    depth, number = np.zeros_like(u), np.zeros_like(u)
    i, j = np.floor(u * cells), np.floor(v * cells)
    for a in range(-2, 3):
        for b in range(-2, 3):
            column, row = (i + a) % cells, (j + b) % cells
            x, y, size = (uniform(seed + k, column, row) for k in range(3))
            distance2 = (u * cells - i - a - x) ** 2 + (v * cells - j - b - y) ** 2
            bowl = (0.5 + 0.5 * size) * (1.0 - distance2 / (0.9 + 0.5 * size) ** 2)
            deeper = bowl > depth
            depth, number = np.where(deeper, bowl, depth), np.where(deeper, row * cells + column, number)
    return depth, number


def coated_copper() -> Material:
    """Hammered copper with patina in its dents, below a clear lacquer that smooths nothing."""
    u, v = lattice()
    moved = [0.006 * layered(u, v, 8, 2, k) for k in (1, 2)]
    depth, blow = dents(u + moved[0], v + moved[1], cells=7, seed=30)
    height = -0.030 * depth + 0.004 * layered(u, v, 4, 3, 3)
    height += 0.0004 * layered(u, v, 40, 2, 4)
    patina = smooth(0.25, 0.75, depth * (0.8 + 0.8 * noise(u, v, (5, 5), 5)) + 0.25 * layered(u, v, 12, 3, 6))
    color = mix((0.90, 0.62, 0.52), (0.36, 0.27, 0.22), 0.85 * patina)
    roughness = 0.28 + 0.30 * patina + 0.08 * uniform(40, blow) + 0.06 * layered(u, v, 24, 2, 7)
    lines = ("metallic: 1", "clearcoat: 1", "clearcoat_roughness: 0.12")
    return Material(height, color, roughness, constants=lines)


def brushed_aluminum() -> Material:
    """Aluminum brushed along u: fine scratches in the BSDF, waves and a few deep scratches as heights."""
    u, v = lattice()
    waves = layered(u, v, 3, 2, 1)
    # A scratch runs along u: noise of few cells across u and many across v, cut off from below.
    scratches = smooth(0.30, 0.62, noise(u, v + 0.002 * noise(u, v, (4, 4), 3), (3, 64), 2))
    height = 0.010 * waves - 0.0030 * scratches + 0.0008 * noise(u, v, (4, 96), 4)
    lines = ("bsdf: {type: roughconductor, material: Al, distribution: ggx, alpha_u: 0.35, alpha_v: 0.1}",)
    return Material(height, constants=lines)
