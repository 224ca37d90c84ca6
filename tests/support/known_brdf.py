"""Materials whose texels have known BRDFs: the network is replaced by a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.directions import normalize
from mbtf_fit.material.material import Material

from .plugin_materials import write_material

F64 = NDArray[np.float64]
# BRDF times cosine of texels (n, 2) [row, column] for directions in the frame of their normals.
Lobe = Callable[[NDArray[np.int64], F64, F64], F64]


@dataclass(frozen=True)
class KnownBrdf(Material):
    """A material whose value at each texel is that of a BRDF around a normal; footprints of level 0 have the
    mean.

    Attributes
    ----------
    slopes : (rows, columns, 2) array
    lobe : Lobe
    """

    slopes: Any = None
    lobe: Any = None

    def evaluate(
        self, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike
    ) -> NDArray[np.float32]:
        rows, columns = self.slopes.shape[:2]
        light, view = (np.asarray(omega, np.float64) for omega in (omega_i, omega_o))
        if np.min(sigma) >= 0.5:
            texels = np.stack(np.mgrid[:rows, :columns], -1).reshape(-1, 2)
            means = [self._at(np.broadcast_to(texel, (len(light), 2)), light, view) for texel in texels]
            return np.mean(means, 0).astype(np.float32)
        at = np.asarray(u, np.float64) % 1.0
        column = np.floor(at[:, 0] * columns).astype(int)
        row = rows - 1 - np.floor(at[:, 1] * rows).astype(int)
        return self._at(np.stack([row, column], 1), light, view).astype(np.float32)

    def _at(self, texel: NDArray[np.int64], omega_i: F64, omega_o: F64) -> F64:
        p, q = self.slopes[tuple(texel.T)].T
        normal = normalize(np.stack([-p, -q, np.ones_like(p)], 1))
        along = normalize(np.stack([np.ones_like(p), np.zeros_like(p), p], 1))
        across = np.cross(normal, along)
        light, view = (
            np.stack([(w * axis).sum(1) for axis in (along, across, normal)], 1) for w in (omega_i, omega_o)
        )
        visible = (light[:, 2] > 0) & (view[:, 2] > 0)
        value = np.where(visible[:, None], self.lobe(texel, light, view), 0.0)
        out: F64 = value / omega_i[:, 2:]
        return out


def known_brdf(folder: Path, slopes: F64, lobe: Lobe, **options: Any) -> KnownBrdf:
    """A material of slopes (rows, columns, 2) and of BRDFs; the number of columns is a power of two."""
    rows, columns = slopes.shape[:2]
    finest = columns.bit_length() - 1
    made = write_material(folder, model="neumip-baseline", finest=finest, aspect=rows / columns, **options)
    given = {field.name: getattr(made, field.name) for field in fields(made)}
    return KnownBrdf(**given, slopes=slopes, lobe=lobe)


def gltf_brdf(base: F64, roughness: F64, metallic: F64) -> Lobe:
    """The metallic-roughness BRDF times the cosine, by the equations of glTF 2.0, appendix B.3, for maps
    (rows, columns, ...); with the visibility of the Khronos sample viewer."""

    def lobe(texel: NDArray[np.int64], light: F64, view: F64) -> F64:
        row, column = texel.T
        color, m = base[row, column], metallic[row, column][:, None]
        alpha = (roughness[row, column] ** 2)[:, None]
        half = normalize(light + view)
        nl, nv = (np.maximum(w[:, 2:], 1e-6) for w in (light, view))
        nh, vh = half[:, 2:], (view * half).sum(1, keepdims=True)
        d = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
        v = 0.5 / (
            nl * np.sqrt(nv**2 * (1 - alpha**2) + alpha**2) + nv * np.sqrt(nl**2 * (1 - alpha**2) + alpha**2)
        )
        schlick = (1 - vh) ** 5
        dielectric = 0.04 + 0.96 * schlick
        mixed = (1 - dielectric) * color / np.pi + dielectric * d * v
        metal = (color + (1 - color) * schlick) * d * v
        return ((1 - m) * mixed + m * metal) * nl

    return lobe
