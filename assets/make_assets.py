#!/usr/bin/env python3
"""Make the small materials of this folder, bit for bit, from formulas alone.

    python assets/make_assets.py [FOLDER]

Each material is a folder with ``height.exr`` (float, heights in tile widths), ``basecolor.png`` (sRGB) and
``roughness.png`` (linear), all 256 × 256 and periodic. Random numbers come from an integer hash and every
result is rounded to a coarse grid (heights to 2^-14 tile widths, colours to 8 bits), so that neither the
version of a library nor the last bit of a sine shows in the files. Row 0 of every image is the side v → 1.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

Field = NDArray[np.float64]

SIZE = 256
QUANTUM = 2.0**-14


@dataclass(frozen=True)
class Material:
    """Maps of one material: height in tile widths (H, W), base colour in sRGB (H, W, 3), roughness (H, W)."""

    height: Field
    basecolor: Field
    roughness: Field


# Building blocks


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
    """a where the weight is 0, b where it is 1; colours have a trailing axis of 3."""
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
    """u and v (H, W) of the texel centres."""
    u, v = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, 1.0 - (np.arange(SIZE) + 0.5) / SIZE)
    return u, v


# Turtle shell

# Centres of the scutes: rows shifted by half a step, then moved a little.
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
    colour = mix(horn, amber, 0.85 * ray)
    colour = mix(colour, (0.70, 0.50, 0.24), 0.9 * smooth(0.24, 0.12, t))
    shade = 0.80 + 0.28 * ridge * on_rings + 0.16 * grains + 0.20 * layered(u, v, 24, 3, 12)
    colour = mix((0.13, 0.10, 0.065), colour * shade[..., None], smooth(1.0, 0.90, t))

    # Polished horn, duller in the valleys of the rings and on the areola; dust in the grooves.
    horn_roughness = 0.34 + 0.10 * (1.0 - ridge) * on_rings + 0.16 * (1.0 - on_rings)
    horn_roughness += 0.12 * layered(u, v, 16, 3, 13)
    return Material(height, colour, mix(0.82, horn_roughness, smooth(1.0, 0.88, t)))


# Straight wool

# Yarns from u = 0 on: width relative to the others, turns of the twist per tile, colour in sRGB. The order
# has no mirror symmetry.
WIDTHS = np.array([1.05, 0.90, 1.20, 0.85, 1.30, 0.70])
TURNS = (3, 3, 3, 4, 2, 4)
COLOURS = np.array(
    [
        (0.60, 0.20, 0.15),
        (0.52, 0.15, 0.14),
        (0.72, 0.42, 0.20),
        (0.57, 0.18, 0.15),
        (0.84, 0.76, 0.62),
        (0.48, 0.15, 0.16),
    ]
)
PLIES = 3
FIBRES = 18  # around a ply
STRAYS = 70


@dataclass(frozen=True)
class Surface:
    """Topmost surface of the yarns.

    Attributes
    ----------
    z : height in tile widths
    yarn, ply : which of them it is; ply `PLIES` stands for the bed below
    angle : position around the ply, from its top, in radians
    """

    z: Field
    yarn: NDArray[np.int64]
    ply: NDArray[np.int64]
    angle: Field


def yarns(u: Field, v: Field) -> Surface:
    """Yarns along v, each of plies that wind about its axis; what lies deepest is a bed of loose fibres."""
    shares = WIDTHS / WIDTHS.sum()
    bed = 0.01 * layered(u, v, 24, 2, 30)
    best = Surface(bed, np.zeros(u.shape, np.int64), np.full(u.shape, PLIES), 3.0 * noise(u, v, (12, 8), 29))
    for yarn, share in enumerate(shares):
        radius = 0.5 * share
        middle = shares[:yarn].sum() + radius
        line = np.full_like(v, (yarn + 0.5) / len(shares))
        bend, swell, slip = (noise(line, v, (len(shares), n), 31 + n) for n in (3, 4, 5))
        across = (u - middle - 0.008 * bend + 0.5) % 1.0 - 0.5
        for ply in range(PLIES):
            turn = 2.0 * np.pi * (TURNS[yarn] * v + uniform(33, yarn) + 0.07 * slip + ply / PLIES)
            thick = 0.53 * radius * (1.0 + 0.16 * swell)
            x = (across - 0.46 * radius * np.cos(turn)) / thick
            z = 0.38 * radius * np.sin(turn) + 0.90 * thick * np.sqrt(np.clip(1.0 - x * x, 0.0, None))
            upper = (np.abs(x) < 1.0) & (z > best.z)
            best = Surface(
                np.where(upper, z, best.z),
                np.where(upper, yarn, best.yarn),
                np.where(upper, ply, best.ply),
                np.where(upper, np.arcsin(np.clip(x, -1.0, 1.0)), best.angle),
            )
    return best


def stray_fibres(u: Field, v: Field) -> Field:
    """Coverage (0 to 1) by single fibres that have come loose and lie across the yarns."""
    cover = np.zeros_like(u)
    for fibre in range(STRAYS):
        x, y, slope, size, curl = (float(uniform(50, fibre, k)[0]) for k in range(5))
        along = (v - y + 0.5) % 1.0 - 0.5
        lean = 1.8 * (slope - 0.5)
        length = 0.05 + 0.12 * size
        middle = x + lean * along + 0.02 * np.sin(along / length * 3.0 + 6.0 * curl)
        apart = np.abs((u - middle + 0.5) % 1.0 - 0.5) / np.hypot(1.0, lean)
        line = smooth(1.25 / SIZE, 0.25 / SIZE, apart) * smooth(length, 0.8 * length, np.abs(along))
        cover = np.maximum(cover, line)
    return cover


def straight_wool() -> Material:
    """Parallel three-ply yarns: plies twisted one way, their fibres the other way, stray fibres across."""
    u, v = lattice()
    surface = yarns(u, v)
    bed = surface.ply == PLIES

    # Position around the ply; fibres make a whole number of turns per tile and so meet at the seam.
    own = surface.yarn * PLIES + np.minimum(surface.ply, PLIES - 1)
    around = surface.angle / (2.0 * np.pi) - v + 0.37 * own
    drift = noise(around, v, (FIBRES // 2, 10), 40)
    fibre = np.abs(np.cos(np.pi * (FIBRES * around + 0.9 * drift))) ** 0.6
    coarse = noise(around, v, (FIBRES, 7), 41)
    stray = stray_fibres(u, v)
    height = surface.z + 0.0055 * fibre + 0.0042 * coarse + 0.0040 * stray

    colour = COLOURS[surface.yarn]
    heather = smooth(-0.15, 0.45, noise(around, v, (FIBRES, 5), 42) + 0.3 * noise(u, v, (32, 32), 43))
    colour = mix(colour, 0.55 * colour + (0.36, 0.33, 0.28), 0.55 * heather)
    colour = colour * (0.80 + 0.22 * fibre + 0.12 * coarse)[..., None]
    colour = mix(colour, 0.5 * colour + (0.40, 0.36, 0.30), 0.7 * stray)
    colour = np.where(bed[..., None], 0.6 * colour, colour)

    roughness = 0.78 - 0.14 * fibre + 0.10 * coarse + 0.10 * bed
    return Material(height, colour, roughness)


# Files

MATERIALS: dict[str, Callable[[], Material]] = {"turtle_shell": turtle_shell, "straight_wool": straight_wool}


def write(material: Material, folder: Path) -> None:
    """Write the maps of a material, rounded; the highest point at 0."""
    import OpenEXR
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    height = np.round((material.height - material.height.max()) / QUANTUM) * QUANTUM + 0.0
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": height.astype(np.float32)}).write(str(folder / "height.exr"))
    for name, image in (("basecolor", material.basecolor), ("roughness", material.roughness)):
        codes = np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
        Image.fromarray(codes).save(folder / f"{name}.png", optimize=True)


def main() -> None:
    """Write all materials below the folder named on the command line, by default the one of this script."""
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent
    for name, make in MATERIALS.items():
        write(make(), target / name)


if __name__ == "__main__":
    main()
