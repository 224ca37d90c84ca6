r"""What a material with holes lets through: a small model, fitted in closed form beside the networks.

The data's ``transmittance`` is the share of a footprint that is seen through holes. It depends on position,
footprint and view, not on the light. Here every texel of every level holds the coefficients of a quadratic
polynomial of the view's projection on the plane,

    T(u, σ, ω_o) = clamp(c_0 + c_1 x + c_2 y + c_3 x² + c_4 x y + c_5 y², 0, 1),  (x, y) = ω_o.xy

read as features are: bilinear in a level, linear between two. A level's coefficients are the least-squares
fit to the queries around each texel, drawn towards those of the next coarser level where queries are few
(ridge regression).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_gen.atomic import digest, write_file
from mbtf_gen.dataset import Dataset
from mbtf_gen.errors import InputError
from mbtf_gen.levels import Lattice, level_of_sigma

TRANSMITTANCE_NAME = "transmittance.safetensors"
COEFFICIENTS = 6
# Queries that the coarser level counts for.
_PRIOR = 4.0
# Trailing axes of the arrays that are read.
TRAILING = {"u": (2,), "sigma": (), "omega_o": (3,), "transmittance": ()}

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def basis(omega_o: ArrayLike) -> F64:
    """(n, 6) polynomials of views (n, 3)."""
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


class Transmittance:
    """The fitted model.

    Parameters
    ----------
    lattice : texel grids of the tile
    levels : (rows, columns, 6) each, coarsest first
    """

    def __init__(self, lattice: Lattice, levels: list[F32]) -> None:
        self.lattice = lattice
        self.levels = levels

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


def write_transmittance(model: Transmittance, path: Path) -> None:
    """Write the coefficients: a tensor ``level.s`` (rows, columns, 6) per level.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    from safetensors.numpy import save

    content = save({f"level.{s}": np.ascontiguousarray(a) for s, a in enumerate(model.levels)})
    write_file(path, lambda stream: _write(stream, content))


def _write(stream: BinaryIO, content: bytes) -> None:
    stream.write(content)


def read_transmittance(folder: Path, description: Mapping[str, Any]) -> Transmittance | None:
    """The model of a material folder; None where the material has no holes.

    Parameters
    ----------
    description : content of its ``material.json``

    Raises
    ------
    InputError : missing or damaged
    """
    stated = description.get("holes")
    if stated is None:
        return None
    path = folder / TRANSMITTANCE_NAME
    if not path.is_file() or digest(path) != stated["sha256"]:
        raise InputError("is missing or not the file that material.json describes", where=path)
    from safetensors.numpy import load_file

    lattice = Lattice(description["levels"]["finest"], description["tile"]["aspect"])
    tensors = load_file(path)
    levels = []
    for s in range(lattice.finest + 1):
        array = tensors.get(f"level.{s}")
        if array is None or array.shape != (*lattice.shape(s), COEFFICIENTS) or not np.isfinite(array).all():
            raise InputError("does not hold the levels that material.json describes", where=path)
        levels.append(np.asarray(array, np.float32))
    return Transmittance(lattice, levels)


def fit_transmittance(data: Dataset) -> Transmittance | None:
    """Fit the model to a data set's training split; None for a material without holes."""
    if "transmittance" not in data.manifest.get("arrays", {}):
        return None
    lattice = data.lattice
    pairs = [(a, b) for a in range(COEFFICIENTS) for b in range(a, COEFFICIENTS)]
    squares = [np.zeros((len(pairs), np.prod(lattice.shape(s)))) for s in range(lattice.finest + 1)]
    products = [np.zeros((COEFFICIENTS, np.prod(lattice.shape(s)))) for s in range(lattice.finest + 1)]
    for part in data.iterate("train", TRAILING):
        u, sigma, omega_o, through = (part[name].reshape(-1, *shape) for name, shape in TRAILING.items())
        level = np.clip(level_of_sigma(sigma.astype(np.float64)), 0.0, lattice.finest)
        for s in range(lattice.finest + 1):
            near = np.flatnonzero(np.abs(level - s) < 1.0)
            if not len(near):
                continue
            texel, weight = corners(u[near], lattice.shape(s))
            weight = weight * (1.0 - np.abs(level[near] - s))[:, None]
            terms, count = basis(omega_o[near]), len(squares[s][0])
            for k, (a, b) in enumerate(pairs):
                w = weight * (terms[:, a] * terms[:, b])[:, None]
                squares[s][k] += np.bincount(texel.ravel(), w.ravel(), count)
            for a in range(COEFFICIENTS):
                w = weight * (terms[:, a] * through[near].astype(np.float64))[:, None]
                products[s][a] += np.bincount(texel.ravel(), w.ravel(), count)
    levels: list[F32] = []
    for s in range(lattice.finest + 1):
        rows, columns = lattice.shape(s)
        prior = _from_coarser(levels, lattice, s)
        ridge = _PRIOR if levels else 1e-3
        matrix = np.empty((rows * columns, COEFFICIENTS, COEFFICIENTS))
        for k, (a, b) in enumerate(pairs):
            matrix[:, a, b] = matrix[:, b, a] = squares[s][k]
        matrix += ridge * np.eye(COEFFICIENTS)
        solved = np.linalg.solve(matrix, (products[s].T + ridge * prior)[..., None])[..., 0]
        levels.append(solved.astype(np.float32).reshape(rows, columns, COEFFICIENTS))
    return Transmittance(lattice, levels)


def _from_coarser(levels: list[F32], lattice: Lattice, s: int) -> F64:
    """Coefficients (texels, 6) of the level before, at the texels of level `s`; zero for the first."""
    rows, columns = lattice.shape(s)
    if not levels:
        return np.zeros((rows * columns, COEFFICIENTS))
    v, u = np.meshgrid(
        1.0 - (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    texel, share = corners(np.stack([u.ravel(), v.ravel()], -1), lattice.shape(s - 1))
    out: F64 = (levels[-1].reshape(-1, COEFFICIENTS)[texel] * share[..., None]).sum(1)
    return out
