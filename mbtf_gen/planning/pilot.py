"""Small runs of the generator itself that measure what leaving effects out costs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_gen.config.effects_request import EFFECTS
from mbtf_gen.planning.bounds import CAUTION
from mbtf_gen.planning.effects import Effect, EffectsPlan
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries

if TYPE_CHECKING:
    from mbtf_gen.generation import Job

# Queries of the pilot and paths of each.
PILOT_QUERIES, PILOT_SPP = 8192, 4
# Interactions before roulette: late ones that few paths reach with great weights would hardly be seen by both
# halves of any query.
PILOT_ROULETTE = 12
# Queries that change more than any that was seen hold, of the mean square, about so many times the share of
# the largest one: α/(α-1) of it where the tail falls off like a power α, 10 for one as heavy as α = 1.1.
UNSEEN = 10.0
# Where fewer queries change, the largest change may be one that none of them shows: it is taken to be as
# large as the mean value.
FEW = 8
# What happens to none of n queries happens to a share of less than 3/n, but for one chance in twenty.
NONE_OF = 3.0


def pilot_queries(job: Job, count: int = PILOT_QUERIES, shard: int = 0) -> Queries:
    """`count` queries drawn like the run's (one leading axis), from a stream of their own; others for every
    `shard`.

    Whatever the layout, each has a footprint and directions of its own: a few buffers would be a few.
    """
    return replace(job.plan(), layout="shuffled", patch_size=None).draw("pilot", shard, count)


@dataclass(frozen=True)
class Change:
    """What leaving something out changed in a sample of queries, relative to the mean value.

    Attributes
    ----------
    count : queries; changed : those with any change
    square, error : mean square change, the product of the halves' changes, which is free of noise, and its
        standard error
    shift, shift_error : mean change and its standard error
    largest : largest change of any query
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
        """Of queries estimated twice."""
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
    def cost(self) -> float:
        """Root mean square change."""
        return float(np.sqrt(max(self.square, 0.0)))

    @property
    def upper(self) -> float:
        """The same plus :data:`CAUTION` standard errors. A root mean square is no smaller than the mean
        change, which is seen also where it is too rare for both halves to show it."""
        square = max(self.square, 0.0) + CAUTION * self.error
        return max(float(np.sqrt(square)), abs(self.shift) + CAUTION * self.shift_error)

    def bound(self, most: float = np.inf) -> float:
        """What the cost is not above, changes that are rarer than the sample shows included.

        Parameters
        ----------
        most : no query changes by more than this. The mean square is then no more than that times the mean.
        """
        largest = self.largest if self.changed >= FEW else max(self.largest, 1.0)
        seen = self.upper**2 + UNSEEN * largest**2 / self.count
        mean = abs(self.shift) + CAUTION * self.shift_error + NONE_OF * largest / self.count
        return float(np.sqrt(min(seen, most * mean)))


def relative_change(full: Estimates, cut: Estimates) -> tuple[float, float]:
    """(cost, the same plus :data:`CAUTION` standard errors) of queries estimated with and without
    something."""
    change = Change.of(full, cut)
    return change.cost, change.upper


class Pilot:
    """Queries of a run under one plan, to be compared with the same under others.

    The random numbers are the same each time, so that what does not change cancels.
    """

    def __init__(self, job: Job, plan: EffectsPlan, spp: int = PILOT_SPP) -> None:
        self.job, self.plan, self.spp = job, plan, spp
        self.queries = pilot_queries(job)
        self.estimator = job.estimator(plan)
        self.full = self._run(self.estimator)

    def _run(self, estimator: Any, limit: int | None = None) -> Estimates:
        stream = Stream(self.job.config.seed, "pilot", 0)
        found: Estimates = estimator.estimate(
            self.queries, self.spp, stream, limit=limit, roulette=PILOT_ROULETTE
        )
        return found

    def limited(self, limit: int) -> Change:
        """What a limit on surface interactions changes; the same kernel."""
        return Change.of(self.full, self._run(self.estimator, limit))

    def changed(self, plan: EffectsPlan) -> Change:
        """What another plan in place of this one changes."""
        return Change.of(self.full, self._run(self.job.estimator(plan)))


def measured(job: Job, plan: EffectsPlan, spp: int = PILOT_SPP) -> EffectsPlan:
    """The plan with the cost of every effect that is on measured, by leaving it out (with what needs it)."""
    from mbtf_gen.planning.effects_plan import without

    if plan.closed_form:
        return plan
    pilot = Pilot(job, plan, spp)

    def look(effect: Effect) -> Effect:
        if not effect.on or not effect.present:
            return effect
        cut = without(plan, effect.name)
        gone = [
            EFFECTS[e.name] for e in plan.effects if e.on and not cut.on(e.name) and e.name != effect.name
        ]
        reason = f"{effect.reason}; with it would go {_listed(gone)}" if gone else effect.reason
        change = pilot.changed(cut)
        error = (change.upper - change.cost) / CAUTION
        return replace(effect, reason=reason, cost=change.cost, error=error, known="pilot")

    return replace(plan, effects=tuple(look(e) for e in plan.effects))


def _listed(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
