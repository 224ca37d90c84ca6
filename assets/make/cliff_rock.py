"""Cliff rock: ledges of bedded stone, broken into blocks, with cracks between them."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from .noise import Field, Indices, lattice, layered, mix, noise, smooth, uniform
from .tile import Material

# Thickness of the beds from v = 0 up, relative to each other, and how far each stands out, 0 to 1.
BEDS = np.array([1.0, 0.45, 1.5, 0.7, 0.35, 1.2, 0.6, 0.9])
STAND = np.array([0.55, 0.10, 0.80, 0.30, 0.00, 1.00, 0.20, 0.65])
BLOCKS = (4, 7, 3, 5, 8, 3, 6, 4)
STONES = np.array(
    [
        (0.55, 0.48, 0.40),
        (0.48, 0.43, 0.37),
        (0.58, 0.51, 0.41),
        (0.51, 0.46, 0.41),
        (0.46, 0.39, 0.33),
        (0.57, 0.51, 0.43),
        (0.53, 0.43, 0.35),
        (0.54, 0.48, 0.42),
    ]
)


def chips(u: Field, v: Field, count: int, flat: float, seed: int) -> Field:
    """Relief, about ±1, of flat breaks: each cell of a Voronoi pattern is a plane with a tilt of its own.

    `flat` > 1 makes the cells wide and low, < 1 narrow and high.
    """
    x, y = uniform(seed, np.arange(count), 1), uniform(seed, np.arange(count), 2)
    near = np.full(u.shape, np.inf)
    relief = np.zeros_like(u)
    scale = np.sqrt(count)
    for site in range(count):
        lean, tip, level = (2.0 * float(uniform(seed, site, k)[0]) - 1.0 for k in (3, 4, 5))
        du = ((u - x[site] + 0.5) % 1.0 - 0.5) * scale / np.sqrt(flat)
        dv = ((v - y[site] + 0.5) % 1.0 - 0.5) * scale * np.sqrt(flat)
        distance = np.hypot(du, dv)
        closer = distance < near
        near = np.where(closer, distance, near)
        relief = np.where(closer, 0.6 * lean * du + 0.6 * tip * dv + 0.5 * level, relief)
    return relief


def beds(u: Field, v: Field) -> tuple[Indices, Indices, Field, Field]:
    """(bed, block, height share within the bed, distance to its outline in tile widths) of points."""
    tops = np.cumsum(BEDS) / BEDS.sum()
    y = v % 1.0
    bed = np.minimum(np.searchsorted(tops, y, side="right"), len(BEDS) - 1)
    thick = (BEDS / BEDS.sum())[bed]
    share = 1.0 - (tops[bed] - y) / thick
    outline = np.minimum(share, 1.0 - share) * thick
    block = np.zeros(u.shape, np.int64)
    for number, count in enumerate(BLOCKS):
        joints = np.sort((np.arange(count) + 0.7 * uniform(80, number, np.arange(count))) / count)
        x = u % 1.0
        found = np.searchsorted(joints, x, side="right")
        left = np.concatenate([[joints[-1] - 1.0], joints])[found]
        right = np.concatenate([joints, [joints[0] + 1.0]])[found]
        here = bed == number
        block = np.where(here, found % count, block)
        outline = np.where(here, np.minimum(outline, np.minimum(x - left, right - x)), outline)
    return bed, block, share, outline


def cliff_rock() -> Material:
    """Weathered sandstone: dark, dirty joints, iron stains, worn edges."""
    u, v = lattice()
    rough_u, rough_v = layered(u, v, 8, 4, 82), layered(u, v, 8, 4, 83)
    fold, fault = layered(u, v, 2, 3, 84), layered(u, v, 3, 2, 85)
    # Joints lean one way or the other; beds swell, pinch and are broken off at faults.
    bent_u = u + 0.035 * rough_u + 0.10 * fault
    bent_v = v + 0.075 * fold + 0.016 * rough_v + 0.035 * (chips(u, v, 14, 0.6, 89))
    bed, block, share, outline = beds(bent_u, bent_v)
    own = [uniform(86 + k, bed, block) for k in range(3)]

    mass = layered(u, v, 2, 3, 100)
    big = chips(u + 0.03 * rough_u, bent_v, 44, 1.8, 90)
    small = chips(u + 0.02 * rough_v, bent_v, 260, 1.6, 91)
    # Beds lean out towards their upper edge; below it the next one is undercut.
    stand = STAND[bed] + 0.6 * (own[0] - 0.5) + 0.40 * (share - 0.5)
    laminae = uniform(92, np.floor(70.0 * (bent_v + 0.006 * rough_u)) % 70)
    height = 0.085 * stand + 0.05 * mass + 0.042 * big + 0.014 * small + 0.005 * (laminae - 0.5)
    open_joint = smooth(-0.15, 0.25, layered(u, v, 6, 2, 93))
    joint = smooth(0.010, 0.0, outline) * open_joint
    height -= 0.030 * joint
    # Later cracks run where a noise changes its sign, and not everywhere.
    sign = layered(u + 0.02 * rough_u, v + 0.02 * rough_v, 3, 3, 94)
    crack = smooth(0.030, 0.0, np.abs(sign)) * smooth(0.0, 0.2, noise(u, v, (4, 3), 95))
    height -= 0.035 * crack
    grain = layered(u, v, 40, 3, 96)
    height += 0.014 * layered(u, v, 12, 4, 97) + 0.0022 * grain

    hollow = height - ndimage.gaussian_filter(height, 5.0, mode="wrap")
    worn = smooth(0.004, 0.022, hollow)
    dirt = smooth(-0.004, -0.028, hollow)
    color = STONES[bed] * (0.92 + 0.22 * (own[1] - 0.5))[..., None]
    stain = smooth(0.05, 0.5, noise(u, v, (9, 2), 98) + 0.35 * rough_u)
    color = mix(color, (0.47, 0.31, 0.19), 0.45 * stain)
    mottle = 0.16 * (laminae - 0.5) + 0.18 * grain + 0.14 * layered(u, v, 6, 3, 99)
    color = color * (1.0 + mottle)[..., None]
    color = mix(color, (0.72, 0.67, 0.58), 0.45 * worn)
    color = mix(color, (0.16, 0.13, 0.11), 0.75 * np.maximum(dirt, np.maximum(0.8 * joint, crack)))
    roughness = 0.82 + 0.08 * dirt - 0.12 * worn + 0.05 * grain
    return Material(height, color, roughness, index=1.54)
