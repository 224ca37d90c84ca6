r"""Energy calibration: the mean reflectance at every elevation is scaled to that of the data.

Networks of this size have errors by direction, and so have the tile's means: 1 to 6% at single elevations,
30 times the uncertainty of the data. Two factors per color correct them,

    M' = M · G_i(l, ω_i,z) · G_o(l, ω_o,z),

each linear between knots of the cosine and between levels. The mean over the tile, and over everything but
one elevation, is equal at all levels: that of the data. With hat functions φ_j about the knots, of the
light's elevation for G_i and of the view's for G_o, each table is the solution, level by level, of

    E[φ_j M'_s] = E[φ_j t] = E[φ_j (t - M)] + E[φ_j M].

t is a query's noisy value; the equations are linear in it, so that the noise averages out. The first term is
a mean over training queries, the others are means over low-discrepancy points, the last one with footprints
of the training queries. The variance of both is known, and the equations are solved with a prior of smooth
factors near 1, so that data with large variance change the factors little.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.directions import from_projected_disk
from mbtf_fit.data.loader import in_region
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.data.streaming import StreamedQueries
from mbtf_fit.ops.constants import KNOTS
from mbtf_fit.sections import HeldOutSection

# Most training queries that are used, and queries per block.
MAX_QUERIES = 1 << 21
_CHUNK = 1 << 18
# Evaluations that are always granted.
_LEAST_EVALUATIONS = 1 << 19
# Points per level, at most: their means at level 0 are within POINT_ERROR (measured: 3.6e-4); fewer where
# queries are few.
POINTS = 1 << 18
_LEAST_POINTS = 1 << 12
# Prior standard deviations of the factors: of second differences between knots, and of distances from 1.
CURVATURES, DISTANCES = (0.0003, 0.001, 0.003, 0.01), (0.003, 0.01, 0.03)
_SECOND = np.diff(np.eye(KNOTS), 2, axis=0)
# Prior covariances of the factors: (pairs, knots, knots).
_PRIORS = np.stack(
    [
        np.linalg.inv(_SECOND.T @ _SECOND / curvature**2 + np.eye(KNOTS) / distance**2)
        for curvature, distance in product(CURVATURES, DISTANCES)
    ]
)
# Relative error of means of level 0 over low-discrepancy points.
POINT_ERROR = 6e-4
# Bins of the cosine.
_BINS = 16 * (KNOTS - 1)
# Hat functions about the knots at the bins' middles: (bins, knots).
_HATS = np.stack(
    [np.interp((np.arange(_BINS) + 0.5) / _BINS, np.linspace(0, 1, KNOTS), e) for e in np.eye(KNOTS)], -1
)
# Largest factor; its inverse is the smallest one.
LARGEST = 2.0
# Alternations between the solutions for G_i and G_o, which depend on each other.
ROUNDS = 2

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
# Values (n, 3) at u, sigma, omega_i, omega_o, and at hints of `relief` where they are known.
Evaluate = Callable[..., F32]


def _bin(omega: F32) -> NDArray[np.int64]:
    """Bins of the cosines of directions (n, 3)."""
    return np.minimum((omega[:, 2].astype(np.float64) * _BINS).astype(np.int64), _BINS - 1)


def _binned(index: NDArray[np.int64], x: F32 | F64, count: int = _BINS) -> F64:
    """Sums (count, 3) of numbers (n, 3) by bin."""
    return np.stack([np.bincount(index, x[:, c], count) for c in range(3)], -1)


def points(start: int, stop: int, largest: float) -> tuple[F32, F32, F32]:
    """Low-discrepancy (u (n, 2), omega_i, omega_o (n, 3)), directions uniform on the projected disk up to a
    radius (additive recurrence by powers of the root of ``x⁷ = x + 1``: Roberts 2018)."""
    root = 1.5
    for _ in range(50):
        root = (1.0 + root) ** (1 / 7)
    x = (0.5 + np.arange(start + 1, stop + 1)[:, None] * root ** -np.arange(1.0, 7.0)) % 1.0
    radius, angle = largest * np.sqrt(x[:, (2, 4)]), 2 * np.pi * x[:, (3, 5)]
    omega = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    return x[:, :2].astype(np.float32), omega[:, 0].astype(np.float32), omega[:, 1].astype(np.float32)


def solve(products: F64, target: F64, covariance: F64) -> F64:
    """Maximum a posteriori factors (knots,) of ``products · factors ≈ target``, with errors of a covariance.

    The prior is the pair of :data:`CURVATURES` and :data:`DISTANCES` of largest marginal likelihood
    (empirical Bayes): deviations that noise explains as well leave the factors at 1.
    """
    scale = float(np.abs(products).sum())
    if scale == 0:
        return np.ones(KNOTS)
    products, target, covariance = products / scale, target / scale, covariance / scale**2
    missing = target - products.sum(1)
    # Knots without queries have neither products nor errors.
    covariance = covariance + 1e-12 * np.eye(KNOTS)
    along = _PRIORS @ products.T
    total = products @ along + covariance
    weighed = np.linalg.solve(total, missing[:, None])[..., 0]
    best = int(np.argmin(np.linalg.slogdet(total)[1] + weighed @ missing))
    factors = 1.0 + along[best] @ weighed[best]
    return np.clip(factors, 1.0 / LARGEST, LARGEST)


def fit_calibration(
    evaluate: Evaluate,
    lattice: Lattice,
    queries: TrainingQueries | StreamedQueries,
    held_out: HeldOutSection,
    bound: Callable[[Tensor], Tensor | None],
    evaluations: int | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
    most_points: int = POINTS,
) -> F32:
    """Tables (2, levels, knots, 3) of G_i and G_o.

    Parameters
    ----------
    evaluate : the fit, without factors
    queries : training queries
    held_out : region without training queries
    bound : Huber bound of the errors of predictions (n, 3); None without one
    evaluations : about the most that it may take; no limit by default
    progress : called with the fraction that is done, after each block
    most_points : points per level, at most
    """
    levels = lattice.finest + 1
    used = most_queries(len(queries), levels, most_points, evaluations)
    total = _points_of(used, most_points)
    # Points are evaluated at each level, and at the footprints of queries.
    work = used + (levels + 1) * total
    done = 0

    def count(n: int) -> None:
        nonlocal done
        done += n
        progress(min(1.0, done / work))

    progress(0.0)
    sums, squares = np.zeros((2, _BINS, 3)), np.zeros((2, _BINS, 3))
    largest = 0.0
    sigmas: list[F32] = []
    for start in range(0, used, _CHUNK):
        part = queries.slice(start, min(start + _CHUNK, used))
        u, sigma, *directions = (a.cpu().numpy() for a in (part.u, part.sigma, part.omega_i, part.omega_o))
        known = {} if part.hints is None else {"hints": part.hints}
        own = evaluate(u, sigma, *directions, **known)
        residual = part.value.cpu().numpy() - own
        most = bound(part.value.new_tensor(own))
        if most is not None:
            residual = residual.clip(-most.cpu().numpy(), most.cpu().numpy())
        for k, omega in enumerate(directions):
            sums[k] += _binned(_bin(omega), residual)
            squares[k] += _binned(_bin(omega), residual.astype(np.float64) ** 2)
            largest = max(largest, float(np.hypot(omega[:, 0], omega[:, 1]).max()))
        sigmas.append(sigma)
        count(len(u))
    footprints = np.resize(np.concatenate(sigmas), total)
    means, spread, kept = _means(evaluate, lattice, held_out, min(largest, 1.0), footprints, count)
    tables = np.ones((2, levels, KNOTS, 3))
    for s in range(levels):
        for c, k in product(range(3), (0, 1) * ROUNDS):
            # Sums over the other elevation, with its current factors.
            other = _HATS @ tables[1 - k, s, :, c]
            mine = means[1 + s, ..., c] @ other if k == 0 else other @ means[1 + s, ..., c]
            wanted = sums[k, :, c] / used + means[0, ..., c].sum(1 - k)
            variance = squares[k, :, c] / used**2 + spread[1 + s, ..., c].sum(1 - k) / kept
            target = _HATS.T @ wanted
            covariance = _HATS.T @ (variance[:, None] * _HATS) + np.diag((POINT_ERROR * target) ** 2)
            tables[k, s, :, c] = solve(_HATS.T @ (mine[:, None] * _HATS), target, covariance)
    return tables.astype(np.float32)


def most_queries(queries: int, levels: int, most_points: int, evaluations: int | None = None) -> int:
    """How many of the training queries are used, within so many evaluations of them and of the points."""
    if evaluations is not None:
        granted = max(evaluations, _LEAST_EVALUATIONS)
        # Points are twice as many as queries, up to a limit.
        queries = min(queries, max(granted // (3 + 2 * levels), granted - (levels + 1) * most_points))
    return min(queries, MAX_QUERIES)


def _points_of(queries: int, most: int) -> int:
    return min(most, max(_LEAST_POINTS, 2 * queries))


def _means(
    evaluate: Evaluate,
    lattice: Lattice,
    held_out: HeldOutSection,
    largest: float,
    sigmas: F32,
    count: Callable[[int], None],
) -> tuple[F64, F64, int]:
    """Means over points of a fit's values with footprints of queries (points,), then at each level, and of
    their squared differences from the first, by bins of light and view: (1 + levels, bins, bins, 3) each; and
    the number of points."""
    out = np.zeros((2, lattice.finest + 2, _BINS * _BINS, 3))
    used = 0
    for start in range(0, len(sigmas), _CHUNK):
        stop = min(start + _CHUNK, len(sigmas))
        u, light, view = points(start, stop, largest)
        kept = ~(in_region(held_out, light) | in_region(held_out, view))
        u, light, view = u[kept], light[kept], view[kept]
        used += len(u)
        index, first = _bin(light) * _BINS + _bin(view), np.zeros((0, 3), np.float32)
        each = (np.full(len(u), sigma_of_level(s), np.float32) for s in range(lattice.finest + 1))
        for s, sigma in enumerate((sigmas[start:stop][kept], *each)):
            value = evaluate(u, sigma, light, view)
            count(stop - start)
            first = value if s == 0 else first
            out[0, s] += _binned(index, value, _BINS * _BINS)
            out[1, s] += _binned(index, (value - first).astype(np.float64) ** 2, _BINS * _BINS)
    means, spread = (out / max(used, 1)).reshape(2, -1, _BINS, _BINS, 3)
    return means, spread, max(used, 1)
