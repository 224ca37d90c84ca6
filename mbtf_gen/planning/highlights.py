r"""Test queries drawn in part by the highlight, with weights.

The error of a fit is a ratio of means over the distribution p of the queries. On glossy materials few
queries with a highlight carry nearly all of its variance. Test queries therefore come from the density

    q = p s,    s = (1 - a) + a g / E_p[g],    g = (E[m³ | l, ω_i, ω_o])^(2/3)

with the share a and the mean m of M over channels. Their weights are 1/s, at most 1/(1 - a). A pilot before
the run fits g as :mod:`mbtf_gen.planning.sample_allocation` fits noise, so that queries depend neither on
the stored values nor on the machine. Squared errors in a highlight are about a share of M², for which √E[m⁴]
would have the least variance; the fourth power needs a larger pilot than the third.

Queries are selected among :data:`CANDIDATES` times as many candidates, half of which have their light near
the mirror direction of the view on the reference plane. The probability of a selection is proportional to s
times the ratio of p to the candidates' density; none is selected twice (systematic sampling, Madow 1949).
Where that would exceed 1, all candidates are selected, with weights that their own density gives.
Footprints and directions decide, so positions are drawn afterwards, as without selection.

By default the pilot also decides whether that pays. Squared errors of about g have over n queries a mean of
variance E_p[g²]/n about, and E_p[g²/s]/n with weights; their ratio is the gain in queries.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.schema import Queries
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.job import Job, split_queries
from mbtf_gen.planning.sample_allocation import direction_terms, evaluate_terms, fit_log_linear, mean_values
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Stream
from mbtf_gen.sampling.exact_math import sincos_turns
from mbtf_gen.sampling.query_sampler import F32, Footprints, QueryPlan

F64 = NDArray[np.float64]

log = logging.getLogger(__name__)

# Candidates per query, and the fewest that are compared.
CANDIDATES, FEWEST = 16, 1024
# Scale of the distribution of lights about the mirror direction of the view, on the projected disk.
MIRROR_SCALE = 0.05
# Paths of each query of the pilot, its share of the paths of the test split, and its fewest and most queries.
PILOT_SPP, PILOT_SHARE = 8, 0.25
PILOT_LEAST, PILOT_MOST = 1 << 12, 1 << 15
# The moment of M that is fitted.
_MOMENT = 3.0
# By default: the share a, and the gain from which it pays.
DEFAULT_SHARE, WORTHWHILE = 0.75, 3.0


@dataclass(frozen=True)
class Highlights:
    """A pilot's prediction of where highlights are.

    Attributes
    ----------
    weights : of the polynomial's terms in footprint and directions, for ln g
    share : a, in (0, 1)
    """

    weights: tuple[float, ...]
    share: float = DEFAULT_SHARE

    def density(self, footprints: Footprints) -> F64:
        """g (n,) of footprints and directions, (1/sr)²."""
        queries = Queries(np.empty((0, 2), np.float32), *footprints)
        return evaluate_terms(self.weights, direction_terms(queries))

    def gain(self, queries: Queries) -> float:
        """How many times as many queries of the distribution p, of which some are given, measure the error
        of a fit as well as queries drawn by highlights."""
        g = self.density((queries.sigma, queries.omega_i, queries.omega_o))
        square = g * g
        return float(np.mean(square) / np.mean(square / self._score(g, float(g.mean()))))

    def _score(self, g: F64, mean: float) -> F64:
        """s (n,) for values of g and their mean over p."""
        return np.ones(len(g)) if mean <= 0 else (1.0 - self.share) + self.share * g / mean

    def draw(self, plan: QueryPlan, shard: int, rows: int) -> tuple[Queries, F32]:
        """Sample the test queries of a shard, as :meth:`~mbtf_gen.sampling.query_sampler.QueryPlan.draw`, and
        their weights, which have the queries' leading axes and, in the mean, the value 1."""
        generator = plan.generator("test", shard)
        count = min(CANDIDATES, rows)
        ends = [rows * part // count for part in range(count + 1)]
        # One part of the candidates at a time, for their memory.
        parts = [
            self._select(generator, plan, max(rows, FEWEST), stop - start) for start, stop in pairwise(ends)
        ]
        sigma, omega_i, omega_o, weight = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        queries = plan.place(generator, "test", shard, (sigma, omega_i, omega_o))
        shape = (rows, *[1] * (len(queries.lead) - 1))
        return queries, np.broadcast_to(weight.reshape(shape), queries.lead).copy()

    def _select(
        self, generator: np.random.Generator, plan: QueryPlan, total: int, count: int
    ) -> tuple[F32, F32, F32, F32]:
        """Footprints, directions and weights of `count` of `total` candidates."""
        sigma, omega_i, omega_o = plan.footprints(generator, total)
        radius = math.sqrt((1.0 - plan.min_cos) * (1.0 + plan.min_cos))
        mirrored, inside = _near_mirror(generator, omega_o[1::2], radius)
        omega_i[1::2] = np.where(inside[:, None], mirrored, omega_i[1::2])
        footprints = sigma, omega_i, omega_o
        # Density of p over that of the candidates; 0 for those outside the range of directions.
        ratio = 1.0 / (0.5 + 0.5 * _mirror_density(omega_i, omega_o) * math.pi * radius**2)
        ratio[1::2] *= inside
        g = self.density(footprints)
        score = self._score(g, _total(ratio * g) / _total(ratio))
        chance = inclusion(ratio * score, count)
        ends = np.cumsum(chance)
        at = (generator.random() + np.arange(count)) * (ends[-1] / count)
        rows = np.searchsorted(ends, at, side="right")
        weight = count / _total(ratio) * ratio[rows] / chance[rows]
        return sigma[rows], omega_i[rows], omega_o[rows], weight.astype(np.float32)


def _total(x: F64) -> float:
    # In order, so that the rounding is the same on every processor.
    return float(np.cumsum(x)[-1])


def _near_mirror(
    generator: np.random.Generator, omega_o: F32, radius: float
) -> tuple[F32, NDArray[np.bool_]]:
    """Directions (n, 3) about the mirror directions of views, and whether they lie on the projected disk of a
    radius. The distance on it has the density of :func:`_mirror_density`."""
    n = len(omega_o)
    distance = MIRROR_SCALE * np.sqrt(1.0 / (1.0 - generator.random(n)) ** 2 - 1.0)
    sine, cosine = sincos_turns(generator.random(n))
    x = distance * cosine - omega_o[:, 0]
    y = distance * sine - omega_o[:, 1]
    square = x * x + y * y
    inside = square <= radius * radius
    z = np.sqrt(1.0 - np.where(inside, square, 0.0))
    return np.stack([x, y, z], axis=-1).astype(np.float32), inside


def _mirror_density(omega_i: F32, omega_o: F32) -> F64:
    """Density (n,) on the projected disk of lights about the mirror directions of views: that of a Cauchy
    distribution in the plane, ``(1 + (r/ε)²)^(-3/2) / (2π ε²)``."""
    x, y = (omega_i[:, k].astype(np.float64) + omega_o[:, k] for k in (0, 1))
    spread = 1.0 + (x * x + y * y) / MIRROR_SCALE**2
    return np.asarray(1.0 / (2.0 * math.pi * MIRROR_SCALE**2 * spread * np.sqrt(spread)))


def inclusion(size: F64, count: int) -> F64:
    """Probabilities ``min(1, c size)`` (n,) whose sum is `count`."""
    certain = np.zeros(len(size), bool)
    while True:
        rest = _total(np.where(certain, 0.0, size))
        left = count - int(certain.sum())
        chance = np.where(certain, 1.0, size * (left / rest if rest > 0 else 0.0))
        above = chance > 1.0
        if not above.any():
            return chance
        certain |= above


def fit_highlights(queries: Queries, value: F64, share: float) -> Highlights | None:
    """Highlights from a pilot's queries (one leading axis) and their mean values (n,), for a share a; None if
    the fit does not converge."""
    weights = fit_log_linear(direction_terms(queries), value**_MOMENT)
    return None if weights is None else Highlights(tuple((weights * (2.0 / _MOMENT)).tolist()), share)


def measure_highlights(job: Job, plan: EffectsPlan, tiles: dict[frozenset[str], Any]) -> Highlights | None:
    """Highlights of a job under an effects plan, by a pilot with its own random numbers; None where test
    queries have the distribution of all.

    By default, that is where the pilot would cost more than its share of the paths of the test queries, and
    where it finds that highlights do not decide. `tiles` as of
    :func:`~mbtf_gen.planning.simulation.build_estimator`.
    """
    given = job.config.queries.test_highlights
    affordable = int(PILOT_SHARE * split_queries(job, "test") * job.config.queries.test_spp / PILOT_SPP)
    if given == 0 or (given is None and affordable < PILOT_LEAST):
        return None
    queries = pilot_queries(job, min(max(affordable, PILOT_LEAST), PILOT_MOST), 2)
    # Shards 0 and 1 are those of the pilots of effects and of the allocation.
    stream = Stream(job.config.seed, "pilot", 2)
    estimates = build_estimator(job, plan, tiles).estimate(queries, PILOT_SPP, stream)
    found = fit_highlights(queries, mean_values(estimates), DEFAULT_SHARE if given is None else given)
    if given is not None and found is None:
        log.warning("the fit of highlights over directions did not converge; test queries are uniform")
    if found is None or (given is None and found.gain(queries) < WORTHWHILE):
        return None
    return found
