"""Straight wool: parallel yarns of a single ply, softly spun, so that their fibers run almost along them."""

from __future__ import annotations

import numpy as np

from .fibers import Surface, strands, stray_fibers
from .noise import Field, lattice, layered, mix, noise, smooth, uniform
from .tile import Material

# Yarns from u = 0 on: width relative to the others, and color in sRGB. The order has no mirror symmetry.
WIDTHS = np.array([1.05, 0.92, 1.12, 0.90, 1.20, 0.85, 1.00, 0.95, 1.10])
RED, WINE, OCHRE, CREAM = (0.68, 0.20, 0.16), (0.55, 0.15, 0.16), (0.82, 0.50, 0.20), (0.86, 0.79, 0.65)
COLORS = np.array([RED, WINE, OCHRE, RED, CREAM, WINE, RED, RED, OCHRE])
FIBRES = 22  # around a yarn


def yarns(u: Field, v: Field) -> Surface:
    """Yarns along v; the tubes' numbers are those of the yarns."""
    shares = WIDTHS / WIDTHS.sum()
    surface = Surface.ground(0.012 * layered(u, v, 32, 2, 30))
    for yarn, share in enumerate(shares):
        half = 0.5 * share
        line = np.full_like(v, (yarn + 0.5) / len(shares))
        bend, swell, rise = (noise(line, v, (len(shares), n), 31 + n) for n in (3, 7, 4))
        offset = (u - shares[:yarn].sum() - half - 0.008 * bend + 0.5) % 1.0 - 0.5
        radius = 1.08 * half * (1.0 + 0.12 * swell)
        x = np.clip(offset / radius, -1.0, 1.0)
        z = 0.012 * rise + 1.10 * radius * np.sqrt(1.0 - x * x)
        surface = surface.with_tube(yarn, offset, radius, z)
    return surface


def straight_wool() -> Material:
    """Heathered reds, ochre and natural wool; loose fibers on top."""
    u, v = lattice()
    surface = yarns(u, v)
    bed = surface.tube < 0
    yarn = np.maximum(surface.tube, 0)

    # One turn of the fibers per tile; how steeply they lean sways along the yarn.
    line = (yarn + 0.5) / len(WIDTHS)
    sway = 0.10 * noise(line, v, (len(WIDTHS), 4), 39)
    around = surface.angle / (2.0 * np.pi) - v + sway + uniform(40, yarn)
    relief, tone = strands(around, v, FIBRES, 10, 41)
    upright = np.where(bed, 0.6, np.cos(surface.angle))
    stray = stray_fibers(u, v, 160, 45)
    lint = layered(u, v, 56, 2, 46)
    height = surface.z + 0.0075 * relief * np.sqrt(upright) + 0.0020 * lint + 0.0030 * stray

    # The dye took unevenly along the yarn.
    color = COLORS[yarn] * (1.0 + 0.50 * noise(line, v, (len(WIDTHS), 3), 47))[..., None]
    color = mix(color, 0.45 * color + (0.44, 0.39, 0.32), 0.55 * smooth(0.62, 0.95, tone))
    color = mix(color, 0.72 * color, smooth(0.35, 0.05, tone))
    color = color * (0.82 + 0.20 * relief + 0.10 * lint)[..., None]
    color = mix(color, 0.6 * color + (0.32, 0.28, 0.24), 0.45 * stray)
    color = np.where(bed[..., None], 0.6 * color, color)

    roughness = 0.84 - 0.12 * relief + 0.06 * lint + 0.05 * bed
    return Material(height, np.minimum(color, 0.92), roughness, index=1.55)
