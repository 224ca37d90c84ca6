"""Small known surfaces: rough, flat, tilted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.geometry import CLEARCOAT, Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_fit.surface.known import KnownSurface

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def rough_heights(rows: int, columns: int, depth: float = 0.2, seed: int = 0) -> F32:
    """Random periodic heights with maximum 0, smooth over a few vertices."""
    random = np.random.default_rng(seed).standard_normal((rows, columns))
    waves = np.fft.fft2(random)
    for axis, size in enumerate((rows, columns)):
        frequency = np.abs(np.fft.fftfreq(size)) * size
        waves = waves * np.expand_dims(1.0 / (1.0 + frequency), 1 - axis)
    z = np.fft.ifft2(waves).real
    z = (z - z.max()) * depth / max(float(np.ptp(z)), 1e-9)
    return z.astype(np.float32)


def heights_at(z: F64, x: F64, y: F64) -> F64:
    """Heights of the triangles over places (x, y); row index of z along +y."""
    px, py = x * z.shape[1] - 0.5, y * z.shape[0] - 0.5
    i, j = np.floor(px).astype(int), np.floor(py).astype(int)
    fx, fy = px - i, py - j
    a, b, c, d = (z[(j + k) % z.shape[0], (i + h) % z.shape[1]] for k in (0, 1) for h in (0, 1))
    return a + (b - a) * fx + (c - a) * fy + (d - b - c + a) * np.maximum(0, fx + fy - 1)


def geometry(
    lattice: Lattice,
    heights: F32,
    *,
    slope: tuple[float, float] = (0.0, 0.0),
    color: tuple[float, float, float] = (0.5, 0.4, 0.3),
    roughness: float | None = None,
    metallic: float = 0.0,
    specular: float = 0.5,
    clearcoat: tuple[float, float] | None = None,
    fibers: bool = False,
    seed: int | None = None,
) -> Geometry:
    """Geometry of heights with constant maps; random maps with a `seed`. A clear coat has weight and
    roughness. Two fibers of random directions, or a gap, lie in each texel."""
    shape = Lattice(lattice.finest + 1, lattice.aspect).shape()
    random = np.random.default_rng(seed)

    def varied(value: NDArray[np.floating]) -> F32:
        full = np.broadcast_to(value, (*shape, *np.shape(value))).astype(np.float32)
        return full if seed is None else full * random.uniform(0.3, 1.0, full.shape).astype(np.float32)

    slopes = varied(np.asarray(slope) if seed is None else np.ones(2))
    moments = np.stack([slopes[..., 0] ** 2, slopes[..., 0] * slopes[..., 1], slopes[..., 1] ** 2], -1)
    glossy = {"roughness": roughness, "metallic": metallic, "specular": specular}
    maps = {} if roughness is None else {n: varied(np.asarray(v)) for n, v in glossy.items()}
    if clearcoat is not None:
        maps |= {n: varied(np.asarray(v)) for n, v in zip(CLEARCOAT, clearcoat, strict=True)}
    base = varied(np.asarray(color))
    if fibers:
        t = random.standard_normal((2, *shape, 3))
        t *= (random.random((*shape, 1)) > 0.2) / np.linalg.norm(t, axis=-1, keepdims=True)
        products = np.einsum("fhwi,fhwj->hwij", t, t)[..., [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] / 2
        moments_of_fibers = products.astype(np.float32)
        maps["tangent_moments"] = moments_of_fibers
        maps["longitudinal_variance"] = 0.1 * moments_of_fibers[..., [0, 3, 5]].sum(-1)
    return Geometry(heights, lattice.aspect, slopes, moments, base_color=base, **maps)


def rough_surface(lattice: Lattice, *, glossy: bool = True, coated: bool = False) -> KnownSurface:
    """A rough surface with random maps."""
    heights = rough_heights(max(1, round(16 * lattice.aspect)), 16)
    layers: dict[str, Any] = {"clearcoat": (1.0, 0.5)} if coated else {}
    if glossy:
        layers |= {"roughness": 0.4, "metallic": 0.7}
    given = geometry(lattice, heights, **layers, fibers=True, seed=0)
    return KnownSurface.of(given, lattice, 5.0)
