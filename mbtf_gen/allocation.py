r"""Which queries get how many paths: more where a pilot expects more noise.

For a given number of paths in all, the mean squared error over queries is smallest when the paths of a query
are in proportion to the standard deviation of one path (Neyman 1934). That deviation is not known, but much
of it follows from level and directions. A pilot before the run, with random numbers of its own, fits

    ln s = quadratic polynomial of (l, ln cos θi, ln cos θo, ω_i·ω_o sideways, ln of the half vector's slope,
                                    azimuths)

and the counts of every query of every shard follow from these weights, which the manifest keeps. So the
counts never look at the paths that they count: every half stays unbiased, the halves stay independent, and a
shard can be made alone.

The same pilot fits the mean value over directions. The mean of M over positions is the tile mean whatever the
footprint, so this is a smooth estimate of the tile mean at any pair of directions.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .estimates import Estimates, Stream
from .queries import Queries

if TYPE_CHECKING:
    from .effects import EffectsPlan
    from .generation import Job

F64 = NDArray[np.float64]

# Queries of the pilot and paths of each; a million paths tell little more.
PILOT_QUERIES, PILOT_SPP = 16384, 16
# Least expected deviation over the mean one: where the pilot saw little noise there may be some.
FLOOR = 0.125
# Counts are powers of two, which fill the nets of the sequences, from one path in each half.
FEWEST = 2
MOST_OVER_MEAN = 64
_STEPS = 40
_RIDGE = 1e-3


def _features(queries: Queries) -> list[F64]:
    """What the polynomial is of, one array (n,) each, all of order one."""
    wi, wo = queries.omega_i.astype(np.float64), queries.omega_o.astype(np.float64)
    level = -np.log2(2.0 * queries.sigma.astype(np.float64))
    half = wi + wo
    length = np.sqrt(half[:, 0] ** 2 + half[:, 1] ** 2 + half[:, 2] ** 2)
    return [
        level / 8.0,
        np.log(wi[:, 2]),
        np.log(wo[:, 2]),
        wi[:, 0] * wo[:, 0] + wi[:, 1] * wo[:, 1],
        0.25 * np.log(1.001 - half[:, 2] / length),
        wi[:, 0],
        wi[:, 1],
        wo[:, 0],
        wo[:, 1],
    ]


def _terms(queries: Queries, *, levels: bool = True) -> list[F64]:
    """1, the features (the level among them or not), and their products in pairs."""
    base = _features(queries)[0 if levels else 1 :]
    products = [base[i] * base[j] for i in range(len(base)) for j in range(i, len(base))]
    return [np.ones(len(queries.sigma)), *base, *products]


def fit_log_linear(terms: list[F64], target: F64) -> F64:
    """Weights w that make ``exp(Σ w·term)`` the mean of a non-negative target (n,): Poisson regression with
    a small ridge, by Newton's method. It weighs large and small targets alike in proportion to their mean and
    needs no distribution beyond that."""
    x = np.stack(terms, axis=1)
    weights = np.zeros(x.shape[1])
    scale = float(target.mean())
    if scale <= 0.0:
        return weights
    y = target / scale
    ridge = _RIDGE * len(y) * np.r_[1e-9, np.ones(x.shape[1] - 1)]
    for _ in range(_STEPS):
        mean = np.exp(np.clip(x @ weights, -20.0, 20.0))
        slope = x.T @ (y - mean) - ridge * weights
        step = np.linalg.solve((x * mean[:, None]).T @ x + np.diag(ridge), slope)
        weights = weights + np.clip(step, -1.0, 1.0)
        if np.abs(step).max() < 1e-6:
            break
    weights[0] += np.log(scale)
    return weights


@dataclass(frozen=True)
class Allocation:
    """What a pilot expects of queries, and the counts of paths that follow.

    Attributes
    ----------
    weights : of the polynomial's terms, for ln s with s the deviation of one path, in 1/sr
    typical : mean of s over the run's queries, in 1/sr; 0 where nothing is noisy
    scale : factor that makes the counts' mean the wanted one, over the run's queries
    gain : mean squared error of equal counts over that of these, as the pilot's own data have it
    mean_weights : of the terms without the level, for ln of the tile mean, in 1/sr
    """

    weights: tuple[float, ...]
    typical: float
    scale: float
    gain: float
    mean_weights: tuple[float, ...]

    def deviation(self, queries: Queries) -> F64:
        """Expected deviation s (n,) of one path, 1/sr."""
        return np.maximum(_evaluate(self.weights, _terms(queries)), FLOOR * self.typical)

    def tile_mean(self, queries: Queries) -> F64:
        """Expected tile mean (n,) at the queries' directions, 1/sr."""
        return _evaluate(self.mean_weights, _terms(queries, levels=False))

    def counts(self, queries: Queries, spp: int) -> NDArray[np.int64]:
        """Paths (n,) of queries for a mean of `spp` over the run, powers of two."""
        if self.typical <= 0.0:
            return np.full(len(queries.sigma), spp, np.int64)
        return _round_counts(self.deviation(queries) * (self.scale * spp / self.typical), spp)

    def to_manifest(self) -> dict[str, Any]:
        """Plain data for the manifest."""
        return asdict(self)

    @classmethod
    def from_manifest(cls, data: dict[str, Any]) -> Allocation:
        """Inverse of :meth:`to_manifest`."""
        names = ("typical", "scale", "gain")
        weights, mean = (tuple(data[name]) for name in ("weights", "mean_weights"))
        return cls(weights=weights, mean_weights=mean, **{name: data[name] for name in names})


def _evaluate(weights: tuple[float, ...], terms: list[F64]) -> F64:
    # Term by term: a matrix product may round differently for other numbers of rows.
    total = np.zeros(len(terms[0]))
    for weight, term in zip(weights, terms, strict=True):
        total += weight * term
    return np.exp(np.clip(total, -60.0, 60.0))


def _round_counts(wanted: F64, spp: int) -> NDArray[np.int64]:
    # The nearest power of two in the sense of ratios.
    power = np.rint(np.log2(np.maximum(wanted, 1e-9)))
    most = math.floor(math.log2(MOST_OVER_MEAN * spp))
    return np.exp2(np.clip(power, math.log2(FEWEST), most)).astype(np.int64)


def fit_allocation(queries: Queries, estimates: Estimates, paths: int, spp: int) -> Allocation:
    """Allocation from a pilot's queries (one leading axis) and estimates of `paths` paths each, for a mean of
    `spp` paths."""
    difference = estimates.value_a.astype(np.float64) - estimates.value_b
    noise = np.sqrt(np.mean(difference**2, axis=-1))
    value = 0.5 * np.mean(estimates.value_a.astype(np.float64) + estimates.value_b, axis=-1)
    weights = fit_log_linear(_terms(queries), noise * (0.5 * math.sqrt(paths)))
    mean_weights = fit_log_linear(_terms(queries, levels=False), value)
    expected = _evaluate(tuple(weights), _terms(queries)) if noise.any() else np.zeros(len(noise))
    flat = Allocation(tuple(weights.tolist()), float(expected.mean()), 1.0, 1.0, tuple(mean_weights.tolist()))
    if not noise.any():
        return flat
    low, high = 1e-3, 1e3
    for _ in range(60):
        middle = math.sqrt(low * high)
        if replace(flat, scale=middle).counts(queries, spp).mean() > spp:
            high = middle
        else:
            low = middle
    fitted = replace(flat, scale=low)
    ratio = spp / fitted.counts(queries, spp)
    return replace(fitted, gain=float(np.mean(noise**2) / np.mean(noise**2 * ratio)))


def measure_allocation(job: Job, plan: EffectsPlan) -> Allocation:
    """Allocation of a job under an effects plan, by a pilot with random numbers of its own."""
    from .pilot import pilot_queries

    queries = pilot_queries(job, PILOT_QUERIES)
    # Shard 0 of the pilots' split is that of the effects plan.
    estimates = job.estimator(plan).estimate(queries, PILOT_SPP, Stream(job.config.seed, "pilot", 1))
    return fit_allocation(queries, estimates, PILOT_SPP, job.config.queries.spp)
