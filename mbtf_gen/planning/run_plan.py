"""The plan of a run: which effects it simulates, and how many paths each query gets."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from mbtf_gen.effects.plan import EffectsPlan
from mbtf_gen.job import Job, planned_paths
from mbtf_gen.planning.effects_planner import plan_effects
from mbtf_gen.planning.sample_allocation import Allocation, measure_allocation

# Runs of fewer paths end before a pilot has paid for itself.
SMALL_RUN = 10_000_000


@dataclass(frozen=True)
class RunPlan:
    """What the manifest fixes for all shards of a data set.

    Attributes
    ----------
    effects : EffectsPlan
        Effects that are simulated.
    allocation : Allocation or None
        Numbers of paths by query; None where all queries get the same.
    """

    effects: EffectsPlan
    allocation: Allocation | None = None

    def to_manifest(self) -> dict[str, Any]:
        """The manifest's keys ``effects`` and ``allocation``."""
        allocation = None if self.allocation is None else asdict(self.allocation)
        return {"effects": self.effects.to_manifest(), "allocation": allocation}


def _is_large(job: Job) -> bool:
    return planned_paths(job, job.shards) >= SMALL_RUN


def plan_run(job: Job) -> RunPlan:
    """Plan a run, by pilots where they pay."""
    return allocate(job, plan_effects(job, pilots=_is_large(job)))


def allocate(job: Job, effects: EffectsPlan) -> RunPlan:
    """The plan of a run that simulates given effects; a pilot allocates the paths under a target error and in
    large runs."""
    queries = job.config.queries
    needed = queries.target_error is not None or (_is_large(job) and queries.allocation == "noise")
    if effects.closed_form or not needed:
        return RunPlan(effects)
    return RunPlan(effects, measure_allocation(job, effects))
