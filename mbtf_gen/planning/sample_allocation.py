r"""Numbers of paths by query: more where a pilot predicts more noise.

For a given total number of paths, the mean squared error over queries is smallest when a query's number of
paths is proportional to the standard deviation of one path (Neyman 1934). This deviation is unknown, but
level and directions predict much of it. A pilot before the run, with its own random numbers, fits

    ln s = quadratic polynomial of (l, ln cos θi, ln cos θo, ω_i·ω_o sideways, ln of the half vector's slope,
                                    azimuths)

The manifest stores these weights, and all counts follow from them by exactly rounded operations. The counts
are therefore independent of the stored paths: both halves stay unbiased and independent, and any machine can
render a shard alone.

The same pilot fits the mean value over directions. The mean of M over positions is the tile mean for every
footprint, so this fit is a smooth estimate of the tile mean at any pair of directions.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.schema import Queries
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.job import Job, split_lights
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling import exact_math as exact

F64 = NDArray[np.float64]

log = logging.getLogger(__name__)

# Queries of the pilot and paths of each; a million paths improve the fit little.
PILOT_QUERIES, PILOT_SPP = 16384, 16
# Smallest predicted deviation, relative to the mean one: the pilot may have missed noise.
FLOOR = 0.125
# Counts are powers of two, which complete the nets of the sequences; at least one path in each half.
FEWEST = 2
MOST_OVER_MEAN = 64
_RIDGE = 1e-3
# Newton's method converges when a step would gain less than this per target. It fails after so many steps, or
# when even the smallest part of a step increases the loss.
_CONVERGED, _STEPS, _LEAST_PART = 1e-10, 50, 1e-9


def _features(queries: Queries) -> list[F64]:
    """Variables of the polynomial, one array (n,) each, of order one."""
    wi, wo = queries.omega_i.astype(np.float64), queries.omega_o.astype(np.float64)
    level = -exact.log(2.0 * queries.sigma.astype(np.float64)) / math.log(2.0)
    half = wi + wo
    length = np.sqrt(half[:, 0] ** 2 + half[:, 1] ** 2 + half[:, 2] ** 2)
    return [
        level / 8.0,
        exact.log(wi[:, 2]),
        exact.log(wo[:, 2]),
        wi[:, 0] * wo[:, 0] + wi[:, 1] * wo[:, 1],
        0.25 * exact.log(1.001 - half[:, 2] / length),
        wi[:, 0],
        wi[:, 1],
        wo[:, 0],
        wo[:, 1],
    ]


def direction_terms(queries: Queries, *, levels: bool = True) -> list[F64]:
    """Terms of the polynomial: 1, the features (with or without the level), and their pairwise products."""
    base = _features(queries)[0 if levels else 1 :]
    products = [base[i] * base[j] for i in range(len(base)) for j in range(i, len(base))]
    return [np.ones(len(queries.sigma)), *base, *products]


def fit_log_linear(terms: list[F64], target: F64) -> F64 | None:
    """Weights w that make ``exp(Σ w·term)`` the mean of a non-negative target (n,): Poisson regression with
    a small ridge (per target, on every weight but the first); None if it does not converge.

    Residuals count relative to the mean, and no distribution of the targets is assumed. The first term is the
    constant, so the fit has the mean of the targets. Newton's steps are halved until they decrease the
    penalized loss, which is convex: full steps overshoot where the targets have a sharp peak.
    """
    x = np.stack(terms, axis=1)
    weights = np.zeros(x.shape[1])
    scale = float(target.mean())
    if scale <= 0.0:
        return weights
    y = target / scale
    penalty = _RIDGE * len(y) * np.r_[1e-9, np.ones(x.shape[1] - 1)]

    def loss(w: F64) -> float:
        line = x @ w
        with np.errstate(over="ignore"):
            return float(np.sum(np.exp(line) - y * line) + 0.5 * np.sum(penalty * w**2))

    now = loss(weights)
    for _ in range(_STEPS):
        mean = np.exp(x @ weights)
        slope = x.T @ (y - mean) - penalty * weights
        step = np.linalg.solve((x * mean[:, None]).T @ x + np.diag(penalty), slope)
        gain = float(slope @ step)
        if gain < _CONVERGED * len(y):
            weights[0] += np.log(scale)
            return weights
        part = 1.0
        while not (after := loss(weights + part * step)) < now - 1e-4 * part * gain:
            part *= 0.5
            if part < _LEAST_PART:
                return None
        weights, now = weights + part * step, after
    return None


@dataclass(frozen=True)
class Allocation:
    """A pilot's predictions of noise and tile mean, and the numbers of paths that follow.

    Attributes
    ----------
    weights : of the polynomial's terms, for ln s with s the standard deviation of one path, in 1/sr
    typical : mean of s over the run's queries, in 1/sr; 0 if all queries get the same number of paths,
        because nothing is noisy or the fit of s did not converge
    scale : factor on the counts that gives them the requested mean over the run's queries
    gain : mean squared error with equal counts over that with these, on the pilot's data
    mean_weights : of the terms without the level, for ln of the tile mean, in 1/sr
    """

    weights: tuple[float, ...]
    typical: float
    scale: float
    gain: float
    mean_weights: tuple[float, ...]

    def deviation(self, queries: Queries) -> F64:
        """Predicted standard deviation s (n,) of one path, 1/sr."""
        return np.maximum(evaluate_terms(self.weights, direction_terms(queries)), FLOOR * self.typical)

    def tile_mean(self, queries: Queries) -> F64:
        """Predicted tile mean (n,) at the queries' directions, 1/sr."""
        return evaluate_terms(self.mean_weights, direction_terms(queries, levels=False))

    def counts(self, queries: Queries, spp: int, lights: int = 1) -> NDArray[np.int64]:
        """Numbers of paths (n,), powers of two, with a mean of `spp` over the run; those of a group of
        `lights` queries are equal, by their root mean square deviation."""
        if self.typical <= 0.0:
            return np.full(len(queries.sigma), spp, np.int64)
        # Column by column: the rounding of a sum may depend on the processor.
        square = sum(one * one for one in self.deviation(queries).reshape(lights, -1))
        deviation = np.tile(np.sqrt(square / lights), lights)
        return _round_counts(deviation * (self.scale * spp / self.typical), spp)


def evaluate_terms(weights: tuple[float, ...], terms: list[F64]) -> F64:
    """``exp(Σ w·term)`` (n,)."""
    # Term by term: the rounding of a matrix product may depend on the number of rows.
    total = np.zeros(len(terms[0]))
    for weight, term in zip(weights, terms, strict=True):
        total += weight * term
    return exact.exp(np.clip(total, -60.0, 60.0))


def _constant(terms: list[F64], value: float) -> F64:
    weights = np.zeros(len(terms))
    weights[0] = math.log(value)
    return weights


def _round_counts(wanted: F64, spp: int) -> NDArray[np.int64]:
    # The nearest power of two on a logarithmic scale.
    power = np.rint(exact.log(np.maximum(wanted, 1e-9)) / math.log(2.0))
    most = math.floor(math.log2(MOST_OVER_MEAN * spp))
    return np.int64(1) << np.clip(power, math.log2(FEWEST), most).astype(np.int64)


def fit_deviation(terms: list[F64], size: F64) -> F64 | None:
    """Weights of ln √E(size²) for sizes (n,) of differences; None if the fit does not converge.

    The fit of the mean size is scaled to the root mean square of the sizes. Means fall short of root mean
    squares by about a tenth for normal noise, and by factors for a few bright paths. A fit of the squares
    would follow the few largest.
    """
    weights = fit_log_linear(terms, size)
    if weights is not None and size.any():
        fitted = evaluate_terms(tuple(weights), terms)
        weights[0] += 0.5 * math.log(float(np.sum(size**2) / np.sum(fitted**2)))
    return weights


def mean_values(estimates: Estimates) -> F64:
    """Mean over channels and halves (n,)."""
    return 0.5 * np.mean(estimates.value_a.astype(np.float64) + estimates.value_b, axis=-1)


def fit_allocation(
    queries: Queries, estimates: Estimates, paths: int, spp: int, lights: int = 1
) -> Allocation:
    """Allocation for a mean of `spp` paths, from a pilot's queries (one leading axis) of `paths` paths each,
    in groups of `lights` queries.
    A constant replaces a fit that does not converge, with a warning."""
    difference = estimates.value_a.astype(np.float64) - estimates.value_b
    noise = np.sqrt(np.mean(difference**2, axis=-1))
    value = mean_values(estimates)
    terms, flat_terms = direction_terms(queries), direction_terms(queries, levels=False)
    mean_weights = fit_log_linear(flat_terms, value)
    if mean_weights is None:
        log.warning("the fit of the tile mean over directions did not converge; a constant is used")
        mean_weights = _constant(flat_terms, float(value.mean()))
    sizes = noise * (0.5 * math.sqrt(paths))
    weights = fit_deviation(terms, sizes)
    uniform = weights is None or not noise.any()
    if weights is None:
        log.warning("the fit of the noise over queries did not converge; a constant is used")
        weights = _constant(terms, math.sqrt(float(np.mean(sizes**2))))
    typical = 0.0 if uniform else float(evaluate_terms(tuple(weights), terms).mean())
    flat = Allocation(tuple(weights.tolist()), typical, 1.0, 1.0, tuple(mean_weights.tolist()))
    if uniform:
        return flat
    low, high = 1e-3, 1e3
    for _ in range(60):
        middle = math.sqrt(low * high)
        if replace(flat, scale=middle).counts(queries, spp, lights).mean() > spp:
            high = middle
        else:
            low = middle
    fitted = replace(flat, scale=low)
    ratio = spp / fitted.counts(queries, spp, lights)
    return replace(fitted, gain=float(np.mean(noise**2) / np.mean(noise**2 * ratio)))


def measure_allocation(
    job: Job, plan: EffectsPlan, tiles: dict[frozenset[str], Any] | None = None
) -> Allocation:
    """Allocation of a job under an effects plan, by a pilot with its own random numbers; `tiles` as of
    :func:`~mbtf_gen.planning.simulation.build_estimator`."""
    lights = split_lights(job.config, "train")
    queries = pilot_queries(job, PILOT_QUERIES - PILOT_QUERIES % lights, lights=lights)
    # The effects plan's pilot uses shard 0 of this split.
    stream = Stream(job.config.seed, "pilot", 1)
    estimates = build_estimator(job, plan, tiles).estimate(queries, PILOT_SPP, stream, lights=lights)
    return fit_allocation(queries, estimates, PILOT_SPP, job.config.queries.spp, lights)
