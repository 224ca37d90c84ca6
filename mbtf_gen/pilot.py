"""Small runs of the generator itself that measure what leaving effects out costs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .effects import EFFECTS, Effect, EffectsPlan
from .estimates import Estimates, Stream
from .queries import Queries
from .relief_costs import CAUTION

if TYPE_CHECKING:
    from .generation import Job

# Queries of the pilot and paths of each.
PILOT_QUERIES, PILOT_SPP = 8192, 4
# Interactions before roulette: late ones that few paths reach with great weights would hardly be seen by both
# halves of any query.
PILOT_ROULETTE = 12


def pilot_queries(job: Job, count: int = PILOT_QUERIES) -> Queries:
    """`count` queries drawn like the run's (one leading axis), from a stream of their own."""
    rows = count if job.config.queries.layout == "shuffled" else max(1, count // job.lattice.texels())
    flat = job.plan().draw("pilot", 0, rows).flat()
    some = slice(0, None, max(1, len(flat.sigma) // count))
    return Queries(flat.u[some], flat.sigma[some], flat.omega_i[some], flat.omega_o[some])


def relative_change(full: Estimates, cut: Estimates) -> tuple[float, float]:
    """(estimate, estimate plus :data:`CAUTION` standard errors) of the RMS change over queries and channels,
    relative to the mean value of `full`. The product of the halves' changes is free of noise. A root mean
    square is no smaller than the mean change, which is seen also where it is too rare for both halves to
    show it."""
    a = (full.value_a - cut.value_a).astype(np.float64)
    b = (full.value_b - cut.value_b).astype(np.float64)
    mean = 0.5 * float(np.mean(full.value_a + full.value_b))
    if mean <= 0.0:
        return 0.0, 0.0
    square = np.mean(a * b, axis=-1)
    error = float(square.std()) / np.sqrt(len(square))
    low = max(float(square.mean()), 0.0)
    change = 0.5 * np.mean(a + b, axis=-1)
    shift = abs(float(change.mean())) + CAUTION * float(change.std()) / np.sqrt(len(change))
    high = max(float(np.sqrt(low + CAUTION * error)), shift)
    return float(np.sqrt(low)) / mean, high / mean


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

    def cost_of_limit(self, limit: int) -> tuple[float, float]:
        """(estimate, cautious estimate) of the cost of a limit on surface interactions; the same kernel."""
        return relative_change(self.full, self._run(self.estimator, limit))

    def cost_of(self, plan: EffectsPlan) -> tuple[float, float]:
        """(estimate, cautious estimate) of the cost of another plan in place of this one."""
        return relative_change(self.full, self._run(self.job.estimator(plan)))


def measured(job: Job, plan: EffectsPlan, spp: int = PILOT_SPP) -> EffectsPlan:
    """The plan with the cost of every effect that is on measured, by leaving it out (with what needs it)."""
    from .planning import without

    if plan.closed_form:
        return plan
    pilot = Pilot(job, plan, spp)

    def look(effect: Effect) -> Effect:
        if not effect.on:
            return effect
        cut = without(plan, effect.name)
        gone = [
            EFFECTS[e.name] for e in plan.effects if e.on and not cut.on(e.name) and e.name != effect.name
        ]
        reason = f"{effect.reason}; its cost is that of {' and '.join(gone)} too" if gone else effect.reason
        cost, upper = pilot.cost_of(cut)
        return replace(effect, reason=reason, cost=cost, error=(upper - cost) / CAUTION, known="pilot")

    return replace(plan, effects=tuple(look(e) for e in plan.effects))
