r"""Transmittance of a material with an opacity mask: a polynomial model beside the networks.

The data's ``transmittance`` is the fraction of a footprint that is transparent. It depends on position,
footprint and view, not on the light. Every texel of every level stores the coefficients of a quadratic
polynomial in the view's projection onto the plane,

    T(u, σ, ω_o) = clamp(c_0 + c_1 x + c_2 y + c_3 x² + c_4 x y + c_5 y², 0, 1),  (x, y) = ω_o.xy

with bilinear interpolation in a level and linear interpolation between levels, like the features.
:mod:`mbtf_fit.material.transmittance_fit` fits them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.lattice import Lattice, level_of_sigma
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_fit.material.format import check_digest, lattice_of
from mbtf_fit.material.storage import read_tensors

TRANSMITTANCE_NAME = "transmittance.safetensors"
COEFFICIENTS = 6
# For a reader of an export.
FORMULA = (
    "transparent fraction of the footprint: clamp(c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2, 0, 1), where "
    "x, y = omega_o.x, omega_o.y and c = the textures transmittance.0 ... transmittance.k at u (without the "
    "neural offset), blended by level like the features; a view from below has the transmittance of the "
    "opposite view from above; values are premultiplied: reflected light only, without transmitted light"
)

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def basis(omega_o: ArrayLike) -> F64:
    """Monomials (n, 6) of views (n, 3)."""
    x, y = np.asarray(omega_o, np.float64)[:, :2].T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)


def corners(u: ArrayLike, shape: tuple[int, int]) -> tuple[NDArray[np.int64], F64]:
    """Texels (n, 4) of a level around uv positions (n, 2), and their bilinear weights (n, 4)."""
    rows, columns = shape
    at = np.asarray(u, np.float64)
    x = (at[:, 0] - np.floor(at[:, 0])) * columns - 0.5
    y = (1.0 - (at[:, 1] - np.floor(at[:, 1]))) * rows - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - left, y - top
    i, j = (left[:, None] + np.array([0, 1])) % columns, (top[:, None] + np.array([0, 1])) % rows
    texel = (j[:, :, None] * columns + i[:, None, :]).reshape(-1, 4)
    weight = np.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx], -1)
    return texel, weight


@dataclass(frozen=True)
class Transmittance:
    """The fitted polynomial model: coefficients (rows, columns, 6) of each level, coarsest first."""

    lattice: Lattice
    levels: list[F32]

    def evaluate(self, u: ArrayLike, sigma: ArrayLike, omega_o: ArrayLike) -> F32:
        """Transmittance (n,) in [0, 1] at uv positions (n, 2), footprints (n,) and views (n, 3)."""
        finest = self.lattice.finest
        level = np.clip(level_of_sigma(np.asarray(sigma, np.float64)), 0.0, finest)
        coarse = np.minimum(level.astype(np.int64), max(0, finest - 1))
        total = np.zeros(len(level))
        terms = basis(omega_o)
        for s, texels in enumerate(self.levels):
            weight = np.clip(1.0 - np.abs(level - s), 0.0, 1.0) * ((s == coarse) | (s == coarse + 1))
            some = np.flatnonzero(weight)
            texel, share = corners(np.asarray(u)[some], self.lattice.shape(s))
            c = (texels.reshape(-1, COEFFICIENTS)[texel] * share[..., None]).sum(1)
            total[some] += weight[some] * (c * terms[some]).sum(1)
        return np.clip(total, 0.0, 1.0).astype(np.float32)


def write_transmittance(model: Transmittance, path: Path) -> Stored:
    """Write the coefficients: a tensor ``level.s`` (rows, columns, 6) per level.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    from safetensors.numpy import save

    levels = {f"level.{s}": np.ascontiguousarray(a) for s, a in enumerate(model.levels)}
    return write_chunks(path, [save(levels)])


def read_transmittance(folder: Path, description: Mapping[str, Any]) -> Transmittance | None:
    """The transmittance of a material folder of that description; None for an opaque material.

    Raises
    ------
    InputError : missing or corrupt
    """
    stated = description.get("transmittance")
    if stated is None:
        return None
    path = check_digest(folder / TRANSMITTANCE_NAME, stated)
    lattice, levels = lattice_of(description), []
    tensors, _ = read_tensors(path, "np")
    for s in range(lattice.finest + 1):
        array = tensors.get(f"level.{s}")
        if array is None or array.shape != (*lattice.shape(s), COEFFICIENTS) or not np.isfinite(array).all():
            raise InputError("does not hold the levels that material.json describes", where=path)
        levels.append(np.asarray(array, np.float32))
    return Transmittance(lattice, levels)
