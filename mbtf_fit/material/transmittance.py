r"""Transmittance of a material with holes: layers of polynomials beside the networks.

The data's ``transmittance`` is the fraction of a footprint that is transparent. It depends on position,
footprint and view, not on the light. A view ray that passes a hole passes it at some depth, so layers of
textures lie at a few depths z_k below the plane, and are read where the ray crosses them. Every texel of
every level stores the coefficients of a quadratic polynomial in the view's projection onto the plane,

    T(u, σ, ω_o) = clamp(Σ_k c_k0 + c_k1 x + c_k2 y + c_k3 x² + c_k4 x y + c_k5 y², 0, 1),  (x, y) = ω_o.xy,
    c_k at u + z_k / max(ω_o.z, 0.05) · (x, y / aspect),

with bilinear interpolation in a level and linear interpolation between levels, like the features.

Layers are fitted one after the other, each to what those before leave. The coefficients of a level are the
least-squares fit to the queries around each texel, in closed form. Ridge regression regularizes them towards
the next coarser level where queries are few.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.dataset import Dataset, Shard
from mbtf_core.data.lattice import Lattice, level_of_sigma
from mbtf_core.data.shard_files import Arrays, check_values
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_core.stats import mean_estimate
from mbtf_fit.material.format import check_digest, lattice_of, read_tensors

if TYPE_CHECKING:
    from mbtf_fit.data.streaming import Selection

TRANSMITTANCE_NAME = "transmittance.safetensors"
COEFFICIENTS = 6
# Depths of the layers, in the order of their fits, over the depth of the surface; of a surface without depth.
_DEPTHS, _FLAT = (0.5, 0.25, 0.75), (0.0,)
# Percentile of the heights that is the depth of the surface: lone pits do not count.
_LOWEST = 5.0
# Smallest cosine of the view that divides depths.
LEAST_COSINE = 0.05
# For a reader of an export.
FORMULA = (
    "transparent fraction of the footprint: clamp(sum over k of c0 + c1 x + c2 y + c3 x^2 + c4 x y + c5 y^2, "
    "0, 1), where x, y = omega_o.x, omega_o.y and c = the textures transmittance.k.0 ... at u + depths[k] / "
    f"max(omega_o.z, {LEAST_COSINE}) (x, y / aspect), without the neural offset, blended by level like the "
    "features; a view from below has the transmittance of the opposite view from above; values are "
    "premultiplied: reflected light only, without transmitted light"
)

# Weight of the coarser level in queries; at the coarsest level, that of the coefficient 0.
_PRIOR, _FIRST_PRIOR = 4.0, 1e-3
# Trailing axes of the arrays that are read.
_TRAILING = {"u": (2,), "sigma": (), "omega_o": (3,), "transmittance": (), "spp": ()}
# Queries and texels per block; most queries of a split that are evaluated.
_BLOCK, _TEXELS, _EVALUATED = 1 << 16, 1 << 16, 1 << 18
# Training queries per texel of the finest level, at most; four times as many lower the error by an eighth.
_PER_TEXEL = 64
# Upper triangle of a texel's matrix.
_FIRST, _SECOND = np.triu_indices(COEFFICIENTS)

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
    """The fitted layers.

    Attributes
    ----------
    depths : z_k of the layers in tile widths, at most 0
    layers : by layer, the coefficients (rows, columns, 6) of each level, coarsest first
    """

    lattice: Lattice
    depths: tuple[float, ...]
    layers: list[list[F32]]

    def evaluate(self, u: ArrayLike, sigma: ArrayLike, omega_o: ArrayLike) -> F32:
        """Transmittance (n,) in [0, 1] at uv positions (n, 2), footprints (n,) and views (n, 3), equal for
        opposite ones."""
        return np.clip(self.sum(u, sigma, omega_o), 0.0, 1.0).astype(np.float32)

    def sum(self, u: ArrayLike, sigma: ArrayLike, omega_o: ArrayLike) -> F64:
        """Sum (n,) of the polynomials, without bounds."""
        finest = self.lattice.finest
        level = np.clip(level_of_sigma(np.asarray(sigma, np.float64)), 0.0, finest)
        coarse = np.minimum(level.astype(np.int64), max(0, finest - 1))
        total = np.zeros(len(level))
        omega_o = np.asarray(omega_o, np.float64)
        omega_o = np.where(omega_o[:, 2:] < 0.0, -omega_o, omega_o)
        terms = basis(omega_o)
        for z, levels in zip(self.depths, self.layers, strict=True):
            at = crossings(u, omega_o, z, self.lattice.aspect)
            for s, texels in enumerate(levels):
                weight = np.clip(1.0 - np.abs(level - s), 0.0, 1.0) * ((s == coarse) | (s == coarse + 1))
                some = np.flatnonzero(weight)
                texel, share = corners(at[some], self.lattice.shape(s))
                c = (texels.reshape(-1, COEFFICIENTS)[texel] * share[..., None]).sum(1)
                total[some] += weight[some] * (c * terms[some]).sum(1)
        return total

    def from_above(self, level: int) -> F32:
        """Transmittance (rows, columns) of a level along the normal."""
        total = np.sum([levels[level][..., 0] for levels in self.layers], axis=0)
        return np.clip(total, 0.0, 1.0).astype(np.float32)


def crossings(u: ArrayLike, omega_o: ArrayLike, z: float, aspect: float) -> F64:
    """uv (n, 2) where view rays through `u` cross the depth z."""
    omega = np.asarray(omega_o, np.float64)
    shift = z / np.maximum(omega[:, 2:], LEAST_COSINE) * omega[:, :2]
    return np.asarray(u, np.float64) + shift / (1.0, aspect)


def write_transmittance(model: Transmittance, path: Path) -> Stored:
    """Write the coefficients: the tensor ``depths`` (layers,), and ``k.s`` (rows, columns, 6) of layer k and
    level s.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    from safetensors.numpy import save

    tensors = {name: np.ascontiguousarray(a) for name, a in named_levels(model).items()}
    return write_chunks(path, [save(tensors | {"depths": np.array(model.depths, np.float32)})])


def named_levels(model: Transmittance) -> dict[str, F32]:
    """Coefficients of each level by layer and level: ``k.s``."""
    return {f"{k}.{s}": a for k, levels in enumerate(model.layers) for s, a in enumerate(levels)}


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
    lattice = lattice_of(description)
    tensors, _ = read_tensors(path, "np")
    shapes = [(*lattice.shape(s), COEFFICIENTS) for s in range(lattice.finest + 1)]

    def take(name: str) -> F32:
        found = tensors.get(name)
        if found is None or found.dtype != np.float32 or not np.isfinite(found).all():
            raise InputError(f"holds no finite 32-bit floats '{name}'", where=path)
        return found

    depths = take("depths")
    if depths.ndim != 1 or not len(depths) or depths.max() > 0.0:
        raise InputError("'depths' are not those of layers below the plane", where=path)
    layers = [[take(f"{k}.{s}") for s in range(len(shapes))] for k in range(len(depths))]
    if any([a.shape for a in levels] != shapes for levels in layers):
        raise InputError("does not hold the levels that material.json describes", where=path)
    return Transmittance(lattice, tuple(map(float, depths)), layers)


def has_transmittance(data: Dataset) -> bool:
    """Whether a data set has a transmittance."""
    return "transmittance" in data.manifest.get("arrays", {})


def _blocks(shard: Shard, chosen: NDArray[np.bool_] | None = None) -> Iterator[Arrays]:
    """Blocks of arrays (n, ...) of the chosen rows of a shard, or of all."""
    trailing = _TRAILING | ({"weight": ()} if shard.weighted else {})
    arrays = shard.map(trailing)
    check_values(arrays, shard.where)
    count = len(arrays["sigma"])
    rows = np.arange(count) if chosen is None else np.flatnonzero(chosen)
    step = max(1, _BLOCK * max(count, 1) // max(arrays["sigma"].size, 1))
    for start in range(0, len(rows), step):
        part = rows[start : start + step]
        yield {name: arrays[name][part].reshape(-1, *shape) for name, shape in trailing.items()}


class _Sums:
    """Normal equations of a level's texels: upper triangles of their matrices, then right-hand sides."""

    def __init__(self, lattice: Lattice, level: int) -> None:
        self.lattice, self.level = lattice, level
        self.sums = np.zeros((lattice.texels(level), len(_FIRST) + COEFFICIENTS))

    def add(self, u: F64, level: F64, products: F64) -> None:
        """Add queries at `u` (n, 2), fractional levels (n,), with their terms (n, 27) of the sums."""
        import torch

        from mbtf_fit.surface.lookup import add_up

        near = np.flatnonzero(np.abs(level - self.level) < 1.0)
        texel, share = corners(u[near], self.lattice.shape(self.level))
        share *= (1.0 - np.abs(level[near] - self.level))[:, None]
        # Most texels of a fine level have no query here.
        found = np.zeros(len(self.sums), bool)
        found[texel] = True
        index = (np.cumsum(found) - 1)[texel]
        places, shares, values = map(torch.from_numpy, (index, share, products[near]))
        self.sums[found] += add_up(places, shares, values, int(found.sum())).numpy()

    def solve(self, levels: list[F32]) -> None:
        """Solve for the texels of the level and write them to `levels`, whose coarser level is complete."""
        out = levels[self.level].reshape(-1, COEFFICIENTS)
        ridge = _PRIOR if self.level else _FIRST_PRIOR
        for start in range(0, len(out), _TEXELS):
            part = slice(start, min(start + _TEXELS, len(out)))
            prior = _from_coarser(levels, self.lattice, self.level, np.arange(part.start, part.stop))
            matrix = np.empty((len(prior), COEFFICIENTS, COEFFICIENTS))
            for k, (a, b) in enumerate(zip(_FIRST, _SECOND, strict=True)):
                matrix[:, a, b] = matrix[:, b, a] = self.sums[part, k]
            matrix += ridge * np.eye(COEFFICIENTS)
            right = self.sums[part, len(_FIRST) :] + ridge * prior
            out[part] = np.linalg.solve(matrix, right[..., None])[..., 0]


def _from_coarser(levels: list[F32], lattice: Lattice, level: int, texel: NDArray[np.int64]) -> F64:
    """Coefficients (n, 6) of the level before, at texels (n,) of a level; zero for the first."""
    if level == 0:
        return np.zeros((len(texel), COEFFICIENTS))
    rows, columns = lattice.shape(level)
    row, column = np.divmod(texel, columns)
    u = np.stack([(column + 0.5) / columns, 1.0 - (row + 0.5) / rows], -1)
    at, share = corners(u, lattice.shape(level - 1))
    out: F64 = (levels[level - 1].reshape(-1, COEFFICIENTS)[at] * share[..., None]).sum(1)
    return out


def _first(selection: Selection, count: float) -> Iterator[Arrays]:
    """Blocks of the first selected rows, until they are as many as `count`; rows are in random order."""
    for path, chosen in selection.masks():
        for block in _blocks(path, chosen):
            yield block
            count -= len(block["sigma"])
            if count <= 0:
                return


def fit_transmittance(data: Dataset, selection: Selection) -> Transmittance | None:
    """Fit the transmittance to the training queries, the rows of `selection`; None for an opaque material."""
    if not has_transmittance(data):
        return None
    lattice, geometry = data.lattice, data.geometry()
    depth = 0.0 if geometry is None else -float(np.percentile(geometry.heights, _LOWEST))
    model = Transmittance(lattice, (), [])
    for part in _DEPTHS if depth > 0.0 else _FLAT:
        z = -float(np.float32(part * depth))
        layer = _fit_layer(data, selection, model, z)
        model = replace(model, depths=(*model.depths, z), layers=[*model.layers, layer])
    return model


def _fit_layer(data: Dataset, selection: Selection, model: Transmittance, z: float) -> list[F32]:
    """Levels of a layer at the depth z, which are fitted to what a model leaves."""
    lattice = data.lattice
    levels = [np.zeros((*lattice.shape(s), COEFFICIENTS), np.float32) for s in range(lattice.finest + 1)]
    sums = [_Sums(lattice, s) for s in range(lattice.finest + 1)]
    # Rows of slices are texels, of which none may be left out.
    most = math.inf if data.layout == "slices" else _PER_TEXEL * lattice.texels(lattice.finest)
    for block in _first(selection, most):
        u, omega_o = block["u"], block["omega_o"]
        level = np.clip(level_of_sigma(block["sigma"].astype(np.float64)), 0.0, lattice.finest)
        terms = basis(omega_o)
        left = block["transmittance"].astype(np.float64) - model.sum(u, block["sigma"], omega_o)
        products = np.concatenate([terms[:, _FIRST] * terms[:, _SECOND], terms * left[:, None]], 1)
        at = crossings(u, omega_o, z, lattice.aspect)
        for part in sums:
            part.add(at, level, products)
    for part in sums:
        part.solve(levels)
    return levels


def evaluate_transmittance(
    model: Transmittance, data: Dataset, selection: Selection
) -> dict[str, dict[str, Any]]:
    """Errors on ``test``, ``held_out`` and ``training`` queries: the first 262 144 of each; a split without
    queries is left out.

    Returns
    -------
    dict
        By split, as plain data: ``n`` queries; ``mse``, the mean squared difference from the data, including
        their noise, as each query has a single estimate; ``noise``, an upper bound of the noise in it, ``t (1
        - t) / (paths - 1)``, the variance of independent paths, of which stratified ones have less;
        ``variance`` of the data's transmittance, noise included.
    """
    sets: dict[str, Iterator[Arrays]] = {}
    if "test" in data.splits:
        sets["test"] = (block for shard in data.shards("test") for block in _blocks(shard))
    sets["held_out"] = (block for shard, chosen in selection.masks() for block in _blocks(shard, ~chosen))
    sets["training"] = (block for shard, chosen in selection.masks() for block in _blocks(shard, chosen))
    found = {name: _error(model, blocks) for name, blocks in sets.items()}
    return {name: error for name, error in found.items() if error}


def _error(model: Transmittance, blocks: Iterator[Arrays]) -> dict[str, Any]:
    parts, left = list[list[F64]](), _EVALUATED
    for block in blocks:
        part = {name: array[:left] for name, array in block.items()}
        t = part["transmittance"].astype(np.float64)
        square = (model.evaluate(part["u"], part["sigma"], part["omega_o"]) - t) ** 2
        noise = t * (1.0 - t) / np.maximum(part["spp"].astype(np.float64) - 1.0, 1.0)
        weight = part["weight"].astype(np.float64) if "weight" in part else np.ones(len(t))
        parts.append([square, noise, t, weight])
        left -= len(t)
        if left <= 0:
            break
    if not parts:
        return {}
    square, noise, t, weight = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    estimates = {
        "mse": mean_estimate(square, weight).as_dict(),
        "noise": mean_estimate(noise, weight).as_dict(),
    }
    return {"n": len(t), **estimates, "variance": float(np.cov(t, ddof=0, aweights=weight))}
