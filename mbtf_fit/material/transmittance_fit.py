"""Fit of the :mod:`~mbtf_fit.material.transmittance` of a data set in closed form, and its error.

A level's coefficients are the least-squares fit to the queries around each texel, drawn towards those of the
next coarser level where queries are few (ridge regression).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.lattice import Lattice, level_of_sigma
from mbtf_core.stats import Estimate, mean_estimate
from mbtf_fit.material.transmittance import COEFFICIENTS, Transmittance, basis, corners
from mbtf_gen.dataset.reader import Dataset
from mbtf_gen.dataset.shard_io import Arrays, read_shard

if TYPE_CHECKING:
    from mbtf_fit.data.streaming import Selection

# Queries that the coarser level counts for, and at the coarsest one the coefficient 0.
_PRIOR, _FIRST_PRIOR = 4.0, 1e-3
# Trailing axes of the arrays that are read.
_TRAILING = {"u": (2,), "sigma": (), "omega_o": (3,), "transmittance": (), "spp": ()}
# Queries, and texels, that are worked on at a time; queries of a set that are judged at most.
_BLOCK, _TEXELS, _JUDGED = 1 << 16, 1 << 16, 1 << 18
# Upper triangle of a texel's matrix.
_PAIRS = [(a, b) for a in range(COEFFICIENTS) for b in range(a, COEFFICIENTS)]
_TEXEL_BYTES = 8 * (len(_PAIRS) + COEFFICIENTS)
# Bytes that sums may take; what needs more is summed in several passes over the shards.
MEMORY = 1e9

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def has_holes(data: Dataset) -> bool:
    """Whether a data set tells what passes through holes."""
    return "transmittance" in data.manifest.get("arrays", {})


def _blocks(path: Path, chosen: NDArray[np.bool_] | None = None) -> Iterator[Arrays]:
    """The arrays of chosen rows of a shard (all by default), some queries at a time: axes (n, ...)."""
    arrays = read_shard(path, _TRAILING)
    count = len(arrays["sigma"])
    rows = np.arange(count) if chosen is None else np.flatnonzero(chosen)
    step = max(1, _BLOCK * max(count, 1) // max(arrays["sigma"].size, 1))
    for start in range(0, len(rows), step):
        part = rows[start : start + step]
        yield {name: arrays[name][part].reshape(-1, *shape) for name, shape in _TRAILING.items()}


class _Sums:
    """Normal equations of consecutive texels of a level."""

    def __init__(self, lattice: Lattice, level: int, first: int, count: int) -> None:
        self.lattice, self.level, self.first, self.count = lattice, level, first, count
        self.squares = np.zeros((len(_PAIRS), count))
        self.products = np.zeros((COEFFICIENTS, count))

    def add(self, block: Arrays) -> None:
        """Take in queries."""
        level = np.clip(level_of_sigma(block["sigma"].astype(np.float64)), 0.0, self.lattice.finest)
        near = np.flatnonzero(np.abs(level - self.level) < 1.0)
        texel, share = corners(block["u"][near], self.lattice.shape(self.level))
        share *= (1.0 - np.abs(level[near] - self.level))[:, None]
        inside = (texel >= self.first) & (texel < self.first + self.count)
        query = np.broadcast_to(np.arange(len(near))[:, None], texel.shape)[inside]
        # Most texels of a fine level see none of a block's queries.
        found, index = np.unique(texel[inside] - self.first, return_inverse=True)
        weight, terms = share[inside], basis(block["omega_o"][near])
        through = block["transmittance"][near].astype(np.float64)
        for k, (a, b) in enumerate(_PAIRS):
            x = weight * (terms[:, a] * terms[:, b])[query]
            self.squares[k, found] += np.bincount(index, x, len(found))
        for a in range(COEFFICIENTS):
            x = weight * (terms[:, a] * through)[query]
            self.products[a, found] += np.bincount(index, x, len(found))

    def solve(self, levels: list[F32]) -> None:
        """Write the texels of the level into `levels`, of which the coarser one is complete."""
        out = levels[self.level].reshape(-1, COEFFICIENTS)
        ridge = _PRIOR if self.level else _FIRST_PRIOR
        for start in range(0, self.count, _TEXELS):
            part = slice(start, min(start + _TEXELS, self.count))
            place = np.arange(self.first + part.start, self.first + part.stop)
            prior = _from_coarser(levels, self.lattice, self.level, place)
            matrix = np.empty((len(place), COEFFICIENTS, COEFFICIENTS))
            for k, (a, b) in enumerate(_PAIRS):
                matrix[:, a, b] = matrix[:, b, a] = self.squares[k, part]
            matrix += ridge * np.eye(COEFFICIENTS)
            right = self.products[:, part].T + ridge * prior
            out[place] = np.linalg.solve(matrix, right[..., None])[..., 0]


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


def _passes(lattice: Lattice, memory: float) -> list[list[tuple[int, int, int]]]:
    """(level, first texel, texels) of each pass over the data, coarse to fine; sums of a pass fit into
    `memory`."""
    room = most = max(1, int(memory / _TEXEL_BYTES))
    out: list[list[tuple[int, int, int]]] = [[]]
    for level in range(lattice.finest + 1):
        first, texels = 0, lattice.texels(level)
        while first < texels:
            if room == 0:
                out.append([])
                room = most
            count = min(room, texels - first)
            out[-1].append((level, first, count))
            first, room = first + count, room - count
    return out


def fit_transmittance(data: Dataset, selection: Selection, memory: float = MEMORY) -> Transmittance | None:
    """Fit the model to what is trained on; None for a material without holes.

    Parameters
    ----------
    selection : rows of the shards that are trained on, as in :class:`~mbtf_fit.data.loader.Partition`
    memory : bytes that sums may take
    """
    if not has_holes(data):
        return None
    lattice = data.lattice
    levels = [np.zeros((*lattice.shape(s), COEFFICIENTS), np.float32) for s in range(lattice.finest + 1)]
    for slots in _passes(lattice, memory):
        sums = [_Sums(lattice, *slot) for slot in slots]
        for path, chosen in selection.masks():
            for block in _blocks(path, chosen):
                for part in sums:
                    part.add(block)
        for part in sums:
            part.solve(levels)
    return Transmittance(lattice, levels)


@dataclass(frozen=True)
class TransmittanceError:
    """How far a model is from the transmittance of queries.

    Attributes
    ----------
    n : queries
    mse : mean squared difference from the data, their noise included: a query has one estimate alone
    noise : what of it the data's noise may be, at most: ``t (1 - t) / (paths - 1)``, that of independent
        paths, which evenly placed ones stay below
    variance : of the data's transmittance, noise included
    """

    n: int
    mse: Estimate
    noise: Estimate
    variance: float

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "n": self.n,
            "mse": self.mse.as_dict(),
            "noise": self.noise.as_dict(),
            "variance": self.variance,
        }


def judge_transmittance(
    model: Transmittance, data: Dataset, selection: Selection
) -> dict[str, TransmittanceError]:
    """Errors on ``test``, on ``held_out`` (queries and directions that were kept out of training), and on
    ``training`` queries; the first 262 144 of each, a set without queries is left out."""
    sets: dict[str, Iterator[Arrays]] = {}
    if "test" in data.splits:
        sets["test"] = (block for shard in data.shards("test") for block in _blocks(shard.path))
    sets["held_out"] = (block for path, chosen in selection.masks() for block in _blocks(path, ~chosen))
    sets["training"] = (block for path, chosen in selection.masks() for block in _blocks(path, chosen))
    found = {name: _error(model, blocks) for name, blocks in sets.items()}
    return {name: error for name, error in found.items() if error is not None}


def _error(model: Transmittance, blocks: Iterator[Arrays]) -> TransmittanceError | None:
    squares, noises, values = [], [], []
    left = _JUDGED
    for block in blocks:
        part = {name: array[:left] for name, array in block.items()}
        t = part["transmittance"].astype(np.float64)
        squares.append((model.evaluate(part["u"], part["sigma"], part["omega_o"]) - t) ** 2)
        noises.append(t * (1.0 - t) / np.maximum(part["spp"].astype(np.float64) - 1.0, 1.0))
        values.append(t)
        left -= len(t)
        if left <= 0:
            break
    if not values:
        return None
    square, noise, value = (np.concatenate(parts) for parts in (squares, noises, values))
    return TransmittanceError(len(value), mean_estimate(square), mean_estimate(noise), float(value.var()))
