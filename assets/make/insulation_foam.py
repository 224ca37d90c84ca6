"""Insulation foam: sprayed foam that rose in lumps, its skin burst by gas bubbles of all sizes."""

from __future__ import annotations

import numpy as np

from .noise import Field, lattice, layered, mix, noise, smooth, uniform
from .tile import Material


def circles(candidates: int, largest: float, smallest: float, room: float, seed: int) -> Field:
    """(n, 3) centers and radii of circles strewn over the periodic tile, the largest first.

    A candidate stays where its center keeps `room` times the sum of the radii from all others.
    """
    number = np.arange(candidates)
    x, y = uniform(seed, number, 0), uniform(seed, number, 1)
    radii = largest * (smallest / largest) ** ((number / candidates) ** 0.6)
    found = np.zeros((0, 3))
    for circle in np.stack([x, y, radii], axis=1):
        apart = np.abs(found[:, :2] - circle[:2])
        apart = np.minimum(apart, 1.0 - apart)
        if np.all(np.hypot(apart[:, 0], apart[:, 1]) > room * (found[:, 2] + circle[2])):
            found = np.concatenate([found, circle[None]])
    return found


def distance(u: Field, v: Field, x: float, y: float) -> Field:
    """Distance on the periodic tile from (x, y)."""
    return np.asarray(np.hypot((u - x + 0.5) % 1.0 - 0.5, (v - y + 0.5) % 1.0 - 0.5))


def lumps(u: Field, v: Field) -> tuple[Field, Field]:
    """(height, crease) of swollen lumps that press against each other; crease is 1 where they meet."""
    highest, second = np.full(u.shape, -1.0), np.full(u.shape, -1.0)
    for number, (x, y, radius) in enumerate(circles(400, 0.17, 0.055, 0.72, 110)):
        swell = 0.75 + 0.5 * float(uniform(111, number)[0])
        dome = 1.0 - (distance(u, v, x, y) / (1.55 * radius)) ** 2
        z = swell * radius * np.where(dome > 0.0, np.sqrt(np.maximum(dome, 0.0)), dome)
        second = np.maximum(second, np.minimum(highest, z))
        highest = np.maximum(highest, z)
    return highest, smooth(0.016, 0.0, highest - second)


def insulation_foam() -> Material:
    """Pale yellow foam, bright enough that light finds its way out of the pits."""
    u, v = lattice()
    warped_u = u + 0.012 * layered(u, v, 6, 3, 112)
    warped_v = v + 0.012 * layered(u, v, 6, 3, 113)
    body, crease = lumps(warped_u, warped_v)

    depth, rim = np.zeros_like(u), np.zeros_like(u)
    bent_u, bent_v = u + 0.4 * (warped_u - u), v + 0.4 * (warped_v - v)
    for number, (x, y, radius) in enumerate(circles(4000, 0.036, 0.0045, 1.27, 114)):
        deep = float(uniform(115, number)[0])
        here = distance(u, v, x, y) < 1.5 * radius + 0.02
        r = distance(bent_u[here], bent_v[here], x, y) / radius
        # The bubble burst above its middle: its wall is upright at the rim, its floor round.
        bowl = np.sqrt(np.clip(1.0 - r * r, 0.0, None)) * smooth(1.0, 0.85, r)
        depth[here] = np.maximum(depth[here], radius * (1.0 + 1.1 * deep) * bowl)
        lip = smooth(0.35, 0.0, np.abs(r - 1.08)) * np.sqrt(radius / 0.036)
        rim[here] = np.maximum(rim[here], lip)
    pores = layered(u, v, 40, 2, 116)
    height = 0.85 * body - 0.010 * crease - depth + 0.0020 * rim
    height += 0.010 * layered(u, v, 10, 2, 117) + 0.0022 * pores

    old = smooth(-0.4, 0.4, layered(u, v, 3, 2, 118))
    color = mix((0.945, 0.885, 0.73), (0.94, 0.855, 0.65), old)
    color = mix(color, (0.93, 0.82, 0.58), 0.6 * smooth(0.0, 0.05, depth) + 0.3 * crease)
    color = mix(color, (0.945, 0.92, 0.82), 0.6 * rim)
    color = color * (0.98 + 0.05 * pores + 0.04 * noise(u, v, (12, 12), 119))[..., None]
    roughness = 0.58 - 0.08 * rim + 0.10 * pores + 0.16 * smooth(0.0, 0.05, depth)
    return Material(height, np.minimum(color, 0.945), roughness)
