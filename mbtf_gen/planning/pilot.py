"""Small runs of the generator that measure the bias of leaving effects out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mbtf_core.data.queries import Queries
from mbtf_gen.job import Job
from mbtf_gen.planning.bounds import CAUTION, FEW, Change
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import EffectsPlan, without
from mbtf_gen.planning.scene import EffectDecision
from mbtf_gen.planning.simulation import build_estimator
from mbtf_gen.render.estimates import Estimates, Stream

# Queries of the pilot and paths of each.
PILOT_QUERIES, PILOT_SPP = 8192, 4
# Interactions before roulette. With early roulette few paths would reach late interactions, with large
# weights, and both halves of a query would hardly ever see the same.
PILOT_ROULETTE = 12


def pilot_queries(job: Job, count: int = PILOT_QUERIES, shard: int = 0) -> Queries:
    """`count` queries (one leading axis) with the run's distribution, from a random stream of their own per
    `shard`.

    In both layouts every query has its own footprint and directions: a few images would have few of them.
    """
    return replace(job.query_plan, layout="shuffled", patch_size=None).draw("pilot", shard, count)


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
