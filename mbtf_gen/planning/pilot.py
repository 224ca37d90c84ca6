"""Small runs of the generator that measure the bias of leaving effects out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mbtf_core.data.schema import Queries
from mbtf_gen.effects.catalog import EFFECTS
from mbtf_gen.effects.effect import EffectDecision
from mbtf_gen.effects.plan import EffectsPlan, without
from mbtf_gen.job import Job
from mbtf_gen.planning.bounds import CAUTION, FEW, NONE_OF
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream

# Queries of the pilot and paths of each.
PILOT_QUERIES, PILOT_SPP = 8192, 4
# Interactions before roulette. With early roulette few paths would reach late interactions, with large
# weights, and both halves of a query would hardly ever see the same.
PILOT_ROULETTE = 12
# The contribution to the mean square of changes larger than the largest sampled one, in units of its own
# contribution: α/(α-1) for a power-law tail of exponent α, so 10 is safe for α = 1.1.
UNSEEN = 10.0


def pilot_queries(job: Job, count: int = PILOT_QUERIES, shard: int = 0) -> Queries:
    """`count` queries (one leading axis) with the run's distribution, from a random stream of their own per
    `shard`.

    In both layouts every query has its own footprint and directions: a few images would have few of them.
    """
    return replace(job.query_plan, layout="shuffled", patch_size=None).draw("pilot", shard, count)


@dataclass(frozen=True)
class Change:
    """Change of a sample of queries when something is left out, relative to the mean value.

    Attributes
    ----------
    count : queries; changed : queries with any change
    square, error : mean square change and its standard error. The product of both halves' changes estimates
        it without bias from noise.
    shift, shift_error : mean change and its standard error
    largest : largest change of a query
    """

    count: int
    changed: int
    square: float
    error: float
    shift: float
    shift_error: float
    largest: float

    @classmethod
    def of(cls, full: Estimates, cut: Estimates) -> Change:
        """Change between two estimates of the same queries."""
        a = (full.value_a - cut.value_a).astype(np.float64)
        b = (full.value_b - cut.value_b).astype(np.float64)
        mean = 0.5 * float(np.mean(full.value_a + full.value_b))
        n = len(a)
        if mean <= 0.0:
            return cls(n, 0, 0.0, 0.0, 0.0, 0.0, 0.0)
        square = np.mean(a * b, axis=-1) / mean**2
        change = 0.5 * np.mean(a + b, axis=-1) / mean
        return cls(
            n,
            int(np.count_nonzero(change)),
            float(square.mean()),
            float(square.std()) / np.sqrt(n),
            float(change.mean()),
            float(change.std()) / np.sqrt(n),
            float(np.sqrt(max(np.abs(square).max(), (change**2).max()))),
        )

    @property
    def rms(self) -> float:
        """Root mean square change."""
        return float(np.sqrt(max(self.square, 0.0)))

    @property
    def upper(self) -> float:
        """Root mean square change plus :data:`CAUTION` standard errors, and at least the mean change plus as
        many: rare changes that never occur in both halves still shift the mean."""
        square = max(self.square, 0.0) + CAUTION * self.error
        return max(float(np.sqrt(square)), abs(self.shift) + CAUTION * self.shift_error)

    def bound(self, most: float = np.inf) -> float:
        """Upper bound of the root mean square change, including changes too rare for the sample. If no change
        exceeds `most`, the mean square is at most `most` times the mean."""
        # We assume that an unsampled change equals the mean value.
        largest = self.largest if self.changed >= FEW else max(self.largest, 1.0)
        seen = self.upper**2 + UNSEEN * largest**2 / self.count
        mean = abs(self.shift) + CAUTION * self.shift_error + NONE_OF * largest / self.count
        return float(np.sqrt(min(seen, most * mean)))


def relative_change(full: Estimates, cut: Estimates) -> tuple[float, float]:
    """(root mean square change, the same plus :data:`CAUTION` standard errors) between two estimates of the
    same queries."""
    change = Change.of(full, cut)
    return change.rms, change.upper


class Pilot:
    """Compares queries of a run under one plan with the same queries under others.

    All estimates use the same random numbers, so that unchanged paths cancel.
    """

    def __init__(self, job: Job, plan: EffectsPlan) -> None:
        self.job = job
        self.queries = pilot_queries(job)
        self._tiles: dict[frozenset[str], Any] = {}
        self.estimator = build_estimator(job, plan, self._tiles)
        self.full = self._run(self.estimator)

    def _run(self, estimator: Any, limit: int | None = None) -> Estimates:
        stream = Stream(self.job.config.seed, "pilot", 0)
        found: Estimates = estimator.estimate(
            self.queries, PILOT_SPP, stream, limit=limit, roulette=PILOT_ROULETTE
        )
        return found

    def limited(self, limit: int) -> Change:
        """Change under a limit on surface interactions, with the same kernel."""
        return Change.of(self.full, self._run(self.estimator, limit))

    def changed(self, plan: EffectsPlan) -> Change:
        """Change under another plan."""
        return Change.of(self.full, self._run(build_estimator(self.job, plan, self._tiles)))


def measured(job: Job, plan: EffectsPlan) -> EffectsPlan:
    """The plan with measured bias bounds: each effect that is on is left out once, with its dependents."""
    if plan.closed_form:
        return plan
    pilot = Pilot(job, plan)

    def measure(effect: EffectDecision) -> EffectDecision:
        if not effect.on or not effect.present:
            return effect
        cut = without(plan, effect.name)
        removed = [
            e.description
            for name, e in EFFECTS.items()
            if name in plan.names_on - cut.names_on - {effect.name}
        ]
        listed = " and ".join([", ".join(removed[:-1]), *removed[-1:]]).removeprefix(" and ")
        text = f"; the bound includes {listed}" if removed else ""
        change = pilot.changed(cut)
        upper = change.upper if change.changed >= FEW else change.bound()
        return replace(
            effect,
            explanation=effect.explanation + text,
            bias_bound=change.rms,
            error=(upper - change.rms) / CAUTION,
            reason="pilot",
        )

    return replace(plan, effects=tuple(measure(e) for e in plan.effects))
