"""Turtle shell: horny scutes with growth rings."""

from __future__ import annotations

import numpy as np

from .noise import Field, lattice, layered, mix, noise, smooth, uniform
from .tile import Material

# Centers of the scutes: rows shifted by half a step, then moved a little.
SCUTES = np.array(
    [
        (0.135, 0.100), (0.535, 0.150), (0.845, 0.085),
        (0.010, 0.385), (0.300, 0.345), (0.690, 0.410),
        (0.205, 0.660), (0.490, 0.600), (0.850, 0.650),
        (0.985, 0.870), (0.350, 0.890), (0.645, 0.850),
    ]
)  # fmt: skip
# A scute grows more on one side than on the other: its oldest part, the areola, lies off its middle.
AREOLA = np.array([0.012, 0.030])


def scute_coordinates(u: Field, v: Field) -> tuple[Field, Field, Field]:
    """(t, azimuth, scute) of points: t is 0 at the scute's areola and 1 on its outline.

    The outline is that of the Voronoi cell with rounded corners: t is the cell's gauge function about the
    areola, the maximum over its sides replaced by a power mean.
    """
    shifts = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    copies = np.array([site + shift for site in SCUTES for shift in shifts])
    nearest = np.stack([(u - x) ** 2 + (v - y) ** 2 for x, y in copies]).argmin(0)
    t = np.zeros_like(u)
    azimuth = np.zeros_like(u)
    for index in np.unique(nearest):
        inside = nearest == index
        site = copies[index]
        number = index // len(shifts)
        moved = np.array([uniform(11, number)[0], uniform(12, number)[0]]) - 0.5
        areola = site + AREOLA + 0.03 * moved
        x, y = u[inside] - areola[0], v[inside] - areola[1]
        total = np.zeros_like(x)
        for other in copies:
            side = other - site
            if 0.0 < side @ side < 0.6:
                reach = (0.5 * (other + site) - areola) @ side
                total += np.maximum((x * side[0] + y * side[1]) / reach, 0.0) ** 10
        t[inside] = total**0.1
        azimuth[inside] = np.arctan2(y, x)
    return t, azimuth, (nearest // len(shifts)).astype(np.float64)


def turtle_shell() -> Material:
    """Horny scutes of a tortoise: low pyramids with growth rings around an areola, grooves between them."""
    u, v = lattice()
    t, azimuth, scute = scute_coordinates(
        u + 0.010 * layered(u, v, 5, 2, 1), v + 0.010 * layered(u, v, 5, 2, 2)
    )
    own = [uniform(20 + k, scute) for k in range(5)]
    on_rings = smooth(0.16, 0.26, t)
    groove = smooth(1.02, 0.86, t)

    # Rings stand closer towards the margin, where growth was slower.
    rings = 5.0 + np.floor(3.0 * own[0])
    age = rings * np.clip(t * (1.0 + 0.05 * layered(u, v, 9, 2, 3)), 0.0, None) ** 1.25
    phase = age - np.floor(age)
    # One ring: a slow rise outwards and a quick fall, worn differently from place to place.
    ridge = smooth(0.0, 0.72, phase) * smooth(1.0, 0.78, phase)
    wear = 0.65 + 0.7 * noise(u, v, (6, 6), 4)
    dome = (0.80 + 0.35 * own[1]) * (1.0 - 0.75 * np.clip(t, 0.0, 1.0) ** 1.5)
    grains = layered(u, v, 48, 2, 5)
    height = 0.062 * dome * groove
    height += 0.0085 * ridge * wear * on_rings * groove
    height += 0.0030 * grains * (1.0 - on_rings)
    height += 0.0012 * layered(u, v, 32, 3, 6) * groove
    height += 0.0035 * layered(u, v, 4, 2, 7)

    # Amber rays run from the areola through dark brown or olive horn; each scute has its own number of them.
    count = 5.0 + np.floor(4.0 * own[2])
    turn = azimuth * count + 2.0 * np.pi * own[3]
    ray = smooth(0.25, 0.85, np.cos(turn + 1.4 * layered(u, v, 8, 2, 8)))
    ray *= smooth(0.10, 0.30, t) * smooth(1.05, 0.80, t + 0.15 * layered(u, v, 16, 2, 9))
    horn = mix((0.30, 0.19, 0.10), (0.37, 0.32, 0.15), smooth(0.2, 0.8, own[4]))
    amber = mix((0.74, 0.55, 0.25), (0.66, 0.58, 0.27), smooth(-0.3, 0.3, noise(u, v, (3, 3), 10)))
    color = mix(horn, amber, 0.85 * ray)
    color = mix(color, (0.70, 0.50, 0.24), 0.9 * smooth(0.24, 0.12, t))
    shade = 0.80 + 0.28 * ridge * on_rings + 0.16 * grains + 0.20 * layered(u, v, 24, 3, 12)
    color = mix((0.13, 0.10, 0.065), color * shade[..., None], smooth(1.0, 0.90, t))

    # Polished horn, duller in the valleys of the rings and on the areola; dust in the grooves.
    horn_roughness = 0.34 + 0.10 * (1.0 - ridge) * on_rings + 0.16 * (1.0 - on_rings)
    horn_roughness += 0.12 * layered(u, v, 16, 3, 13)
    return Material(height, color, mix(0.82, horn_roughness, smooth(1.0, 0.88, t)))
