r"""Mean reflectance of a fit at every elevation, set to that of its data.

A network of this size errs by directions, and so do the tile's means: by one to six per cent of themselves at
single elevations, some thirty times what the data leave uncertain. Two factors per colour take that out,

    M' = M · G_i(l, ω_i,z) · G_o(l, ω_o,z),

each linear between knots of the cosine and between levels. The mean over the tile, and over everything but
one elevation, is the same at every level: that of the data. With hat functions φ_j about the knots, of the
light's elevation for G_i and of the view's for G_o, each table therefore solves, level by level,

    E[φ_j M'_s] = E[φ_j t] = E[φ_j (t - M)] + E[φ_j M].

t is a query's noisy value, in which all of this is linear: noise averages out. The first term is a mean over
training queries, each at its own level, the others are means over low-discrepancy points, which are cheap.
What remains uncertain is known too, so that the equations are solved together with the expectation that
factors are smooth and near 1: data that say little change little.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mbtf_gen.directions import from_projected_disk
from mbtf_gen.levels import Lattice, sigma_of_level

from .config import HeldOutSection
from .data import TrainingQueries, in_region
from .models.gains import KNOTS
from .streaming import StreamedQueries

# Training queries that are looked at, at most, and at a time.
MOST = 1 << 22
_CHUNK = 1 << 18
# Points per level, at most; fewer where queries are few, for what they say is then less certain by far.
POINTS = 1 << 17
_LEAST_POINTS = 1 << 12
# What may be expected of factors beforehand: second differences between knots, and distances from 1.
CURVATURES, DISTANCES = (0.0003, 0.001, 0.003, 0.01), (0.003, 0.01, 0.03)
_SECOND = np.diff(np.eye(KNOTS), 2, axis=0)
# The covariances of factors that go with them: (pairs, knots, knots).
_PRIORS = np.stack(
    [
        np.linalg.inv(_SECOND.T @ _SECOND / curvature**2 + np.eye(KNOTS) / distance**2)
        for curvature, distance in product(CURVATURES, DISTANCES)
    ]
)
# Relative error of means over so many points; it falls with the root of their number, at least.
POINT_ERROR = 5e-4
# Factors stay within this and its inverse.
LARGEST = 2.0
# G_i and G_o depend on each other: how often they are solved in turn.
ROUNDS = 2

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
# Values (n, 3) at u, sigma, omega_i, omega_o.
Evaluate = Callable[[F32, F32, F32, F32], F32]


@dataclass(frozen=True)
class _Hats:
    """Hat functions about the knots, of cosines (n,)."""

    left: NDArray[np.int64]
    inside: F64

    @classmethod
    def of(cls, omega: F32) -> _Hats:
        x = np.clip(omega[:, 2].astype(np.float64), 0.0, 1.0) * (KNOTS - 1)
        left = np.minimum(x.astype(np.int64), KNOTS - 2)
        return cls(left, x - left)

    def sums(self, x: F64) -> F64:
        """Σ φ_j x of numbers (n,): (knots,)."""
        return self._at(0, (1 - self.inside) * x) + self._at(1, self.inside * x)

    def products(self, x: F64) -> F64:
        """Σ φ_j φ_k x: (knots, knots)."""
        own = self._at(0, (1 - self.inside) ** 2 * x) + self._at(1, self.inside**2 * x)
        beside = self._at(0, self.inside * (1 - self.inside) * x)[:-1]
        return np.diag(own) + np.diag(beside, 1) + np.diag(beside, -1)

    def read(self, table: F64) -> F64:
        """A table's (knots,) factors at the cosines."""
        return table[self.left] * (1 - self.inside) + table[self.left + 1] * self.inside

    def _at(self, step: int, x: F64) -> F64:
        return np.bincount(self.left + step, x, KNOTS).astype(np.float64)


def points(count: int, largest: float) -> tuple[F32, F32, F32]:
    """Low-discrepancy (u (count, 2), omega_i, omega_o (count, 3)), directions uniform on the projected disk
    up to a radius (additive recurrence by powers of the root of ``x⁷ = x + 1``: Roberts 2018)."""
    root = 1.5
    for _ in range(50):
        root = (1.0 + root) ** (1 / 7)
    x = (0.5 + np.arange(1, count + 1)[:, None] * root ** -np.arange(1.0, 7.0)) % 1.0
    radius, angle = largest * np.sqrt(x[:, (2, 4)]), 2 * np.pi * x[:, (3, 5)]
    omega = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    return x[:, :2].astype(np.float32), omega[:, 0].astype(np.float32), omega[:, 1].astype(np.float32)


def solve(products: F64, target: F64, covariance: F64) -> F64:
    """The likeliest factors (knots,) with ``products · factors ≈ target``, whose errors have this covariance.

    Of the expectations in :data:`CURVATURES` and :data:`DISTANCES` the pair is taken under which the data are
    likeliest (empirical Bayes): what noise explains as well is left at 1.
    """
    scale = float(np.abs(products).sum())
    if scale == 0:
        return np.ones(KNOTS)
    products, target, covariance = products / scale, target / scale, covariance / scale**2
    missing = target - products.sum(1)
    # Knots that nothing is near to have neither products nor errors.
    covariance = covariance + 1e-12 * np.eye(KNOTS)
    along = _PRIORS @ products.T
    total = products @ along + covariance
    weighed = np.linalg.solve(total, missing[:, None])[..., 0]
    best = int(np.argmin(np.linalg.slogdet(total)[1] + weighed @ missing))
    factors = 1.0 + along[best] @ weighed[best]
    return np.clip(factors, 1.0 / LARGEST, LARGEST)


def fit_gains(
    evaluate: Evaluate,
    lattice: Lattice,
    queries: TrainingQueries | StreamedQueries,
    held_out: HeldOutSection,
    bound: Callable[[Tensor], Tensor | None],
) -> F32:
    """Tables (2, levels, knots, 3) of G_i and G_o.

    Parameters
    ----------
    evaluate : the fit, without factors
    queries : that it was trained on
    held_out : which of their directions are missing
    bound : largest errors of predictions (n, 3) that count; None where all do
    """
    used = min(len(queries), MOST)
    sums, squares = np.zeros((2, KNOTS, 3)), np.zeros((2, 3, KNOTS, KNOTS))
    largest, sigmas = 0.0, np.empty(0, np.float32)
    for start in range(0, used, _CHUNK):
        part = queries.slice(start, min(start + _CHUNK, used))
        u, sigma, *directions = (a.cpu().numpy() for a in (part.u, part.sigma, part.omega_i, part.omega_o))
        own = evaluate(u, sigma, *directions)
        missed = (part.value.cpu().numpy() - own).astype(np.float64)
        most = bound(part.value.new_tensor(own))
        if most is not None:
            missed = missed.clip(-most.cpu().numpy(), most.cpu().numpy())
        for k, omega in enumerate(directions):
            hats = _Hats.of(omega)
            for c in range(3):
                sums[k, :, c] += hats.sums(missed[:, c])
                squares[k, c] += hats.products(missed[:, c] ** 2)
            largest = max(largest, float(np.hypot(omega[:, 0], omega[:, 1]).max()))
        sigmas = sigma if len(sigmas) == 0 else sigmas
    count = min(POINTS, max(_LEAST_POINTS, 2 * used))
    u, light, view = points(count, min(largest, 1.0))
    seen = ~(in_region(held_out, light) | in_region(held_out, view))
    u, light, view = u[seen], light[seen], view[seen]
    both, n = (_Hats.of(light), _Hats.of(view)), len(u)
    as_data = evaluate(u, np.resize(sigmas, n), light, view).astype(np.float64)
    tables = np.ones((2, lattice.finest + 1, KNOTS, 3))
    for s in range(lattice.finest + 1):
        sigma = np.full(n, sigma_of_level(s), np.float32)
        value = evaluate(u, sigma, light, view).astype(np.float64)
        for c in range(3):
            for k in (0, 1) * ROUNDS:
                mine, other = both[k], both[1 - k].read(tables[1 - k, s, :, c])
                target = sums[k, :, c] / used + mine.sums(as_data[:, c]) / n
                products = mine.products(value[:, c] * other) / n
                own = np.diag((POINT_ERROR * target) ** 2 * (POINTS / count))
                tables[k, s, :, c] = solve(products, target, squares[k, c] / used**2 + own)
    return tables.astype(np.float32)
