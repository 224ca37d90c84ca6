"""The plan of a run: which effects it simulates, how many paths each query gets, where test queries lie.

Every effect proposes, the user's request counts, and a tolerance is divided. Pilots, small runs of the
generator, measure the bias of leaving effects out where theory gives no bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from mbtf_gen.planning.bounds import CAUTION, FEW, POINTS, Change, DisplacementBounds, displacement_bounds
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import EffectsPlan, consistent, without
from mbtf_gen.planning.highlights import Highlights, measure_highlights
from mbtf_gen.planning.job import Job, planned_paths
from mbtf_gen.planning.sample_allocation import PILOT_QUERIES as ALLOCATION_QUERIES
from mbtf_gen.planning.sample_allocation import PILOT_SPP as ALLOCATION_SPP
from mbtf_gen.planning.sample_allocation import Allocation, measure_allocation
from mbtf_gen.planning.scene import EffectDecision, EffectsRequest, PlanScene
from mbtf_gen.planning.simulation import build_estimator, pilot_queries
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.light_kernel import LightKernel

# Paths of training queries below which runs end before the pilots of effects have paid, and before that of
# the allocation. Test queries do not count: they change no training data.
SMALL_RUN, SMALLEST_ALLOCATED = 10_000_000, 10 * ALLOCATION_QUERIES * ALLOCATION_SPP
# Queries of the pilot and paths of each.
PILOT_QUERIES, PILOT_SPP = 8192, 4
# Interactions before roulette. With early roulette few paths would reach late interactions, with large
# weights, and both halves of a query would hardly ever see the same.
PILOT_ROULETTE = 12


@dataclass(frozen=True)
class RunPlan:
    """What the manifest fixes for all shards of a data set.

    Attributes
    ----------
    effects : effects that are simulated
    allocation : numbers of paths by query; None where all queries get the same
    highlights : where test queries are concentrated; None where they have the distribution of the others
    """

    effects: EffectsPlan
    allocation: Allocation | None = None
    highlights: Highlights | None = None

    def to_manifest(self) -> dict[str, Any]:
        """The manifest's keys ``effects``, ``allocation`` and ``highlights``."""
        measured = {"allocation": self.allocation, "highlights": self.highlights}
        stated = {name: None if one is None else asdict(one) for name, one in measured.items()}
        return {"effects": self.effects.to_manifest(), **stated}


def _training_paths(job: Job) -> int:
    return planned_paths(job, (entry for entry in job.shards if entry.split == "train"))


def skips_pilots(job: Job) -> bool:
    """Whether a run is too small for pilots of effects."""
    return _training_paths(job) < SMALL_RUN


def plan_run(job: Job, note: Callable[[str], None] = lambda phase: None) -> RunPlan:
    """Plan a run, by pilots where they pay; `note` is called with each phase."""
    note("building the scene, compiling kernels, pilot paths of the effects")
    effects = plan_effects(job, pilots=not skips_pilots(job))
    note("pilot paths of noise and highlights")
    return allocate(job, effects)


def allocate(job: Job, effects: EffectsPlan) -> RunPlan:
    """The plan of a run that simulates given effects; pilots allocate the paths under a target error and
    where that pays, and find the highlights by which test queries are drawn."""
    queries = job.config.queries
    if effects.closed_form:
        return RunPlan(effects)
    pays = queries.allocation == "noise" and _training_paths(job) >= SMALLEST_ALLOCATED
    needed = queries.target_error is not None or pays
    tiles: dict[frozenset[str], Any] = {}
    return RunPlan(
        effects,
        measure_allocation(job, effects, tiles) if needed else None,
        measure_highlights(job, effects, tiles),
    )


def plan_effects(job: Job, *, pilots: bool = True) -> EffectsPlan:
    """Decide which effects a run simulates.

    Parameters
    ----------
    pilots : whether pilots measure where theory gives no bound; otherwise such effects stay on

    Raises
    ------
    UsageError : the user requests an unknown effect, one that the material lacks, or one that needs another
        that is switched off
    """
    request = EffectsRequest.parse(job.config.effects.mode, EFFECTS)
    scene = PlanScene(job, request)
    scene.pilots = _ScenePilots(scene) if pilots else None
    scene.share_out({e.name: e.propose(scene) for e in EFFECTS.values() if e.stage == "reflection"})
    if not any(decision.on for decision in scene.decided.values()):
        scene.lambert = True
    scene.bounds = _displacement_bounds(scene)
    scene.share_out({e.name: e.propose(scene) for e in EFFECTS.values() if e.stage == "maps"})
    black = not scene.albedo.any() and scene.lambert and not scene.decided["opacity"].on
    if scene.flat or black:
        scene.undisplaced = ("flat" if scene.flat else "black: reflects nothing"), "exact"
    travel = (effect for effect in EFFECTS.values() if effect.stage == "transport")
    for effect in sorted(travel, key=lambda effect: effect.order):
        scene.decided[effect.name] = request.decide(effect.propose(scene))
    plan = _plan(scene)
    if request.base != "all" and _has_closed_form(scene, plan):
        plan = replace(plan, closed_form=True)
    return replace(plan, tolerance=job.config.effects.tolerance)


def reference_plan(job: Job) -> EffectsPlan:
    """The plan of reference pictures: all effects that the material has, whatever their size."""
    request = EffectsRequest.parse(job.config.effects.mode, EFFECTS)
    scene = PlanScene(job, request)
    scene.decided = {name: request.decide(effect.reference(scene)) for name, effect in EFFECTS.items()}
    return _plan(scene)


def _plan(scene: PlanScene, proposals: Mapping[str, EffectDecision] | None = None) -> EffectsPlan:
    """The plan of the decisions so far, and of proposals in place of some."""
    extra = {name: scene.request.decide(decision) for name, decision in (proposals or {}).items()}
    decided = consistent({**scene.decided, **extra}, scene.request)
    config = scene.job.config
    return EffectsPlan(
        tuple(decided[name] for name in EFFECTS),
        scene.cap,
        scene.cap_bound,
        config.transport.roulette_depth,
        config.effects.mode,
    )


class Pilot:
    """Compares queries of a run under one plan with the same queries under others.

    All estimates use the same random numbers, so that unchanged paths cancel.
    """

    def __init__(self, job: Job, plan: EffectsPlan) -> None:
        self.job = job
        self.queries = pilot_queries(job, PILOT_QUERIES)
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


class _ScenePilots:
    """Pilots of a scene, see :class:`mbtf_gen.planning.scene.Pilots`."""

    def __init__(self, scene: PlanScene) -> None:
        self.scene = scene

    def change_without(self, name: str, proposals: Mapping[str, EffectDecision]) -> Change:
        plan = _plan(self.scene, proposals)
        return Pilot(self.scene.job, plan).changed(without(plan, name))

    def change_of_layer(self, name: str, strength: float) -> Change:
        full = np.asarray(self.scene.tile.maps[name]) / strength
        job = Job.of(self.scene.job.config, self.scene.tile.with_maps(**{name: full}))
        plan = reference_plan(job)
        return Pilot(job, plan).changed(without(plan, name))

    def capped(self, proposals: Mapping[str, EffectDecision]) -> Callable[[int], Change]:
        return Pilot(self.scene.job, _plan(self.scene, proposals)).limited


def _displacement_bounds(scene: PlanScene) -> DisplacementBounds | None:
    """Bias bounds of displacement and normal map; None unless they apply, to a Lambert surface that is not
    black."""
    grid, mapped = scene.tile.grid, scene.mapped
    if grid is None or (scene.flat and mapped is None):
        return None
    if not (scene.lambert and scene.albedo.any() and scene.pilots):
        return None
    queries = pilot_queries(scene.job, POINTS)
    return displacement_bounds(
        grid,
        queries.omega_i.astype(np.float64),
        queries.omega_o.astype(np.float64),
        LightKernel(scene.light_width),
        scene.albedo,
        None if mapped is None else mapped[0],
        scene.passing,
    )


def _has_closed_form(scene: PlanScene, plan: EffectsPlan) -> bool:
    """Whether M follows without tracing: a plane of one Lambert color, or black."""
    on = plan.names_on
    if any(EFFECTS[name].stage == "reflection" for name in on) or "opacity" in on:
        return False
    if scene.tile.bsdf_type is not None:
        return False
    base: Any = np.asarray(scene.tile.base_color)
    if not base.any():
        return True
    one = bool(np.all(base == base.reshape(-1, 3)[0]))
    return one and scene.flat and not on & {"parallax", "normal"}


def measured(job: Job, plan: EffectsPlan) -> EffectsPlan:
    """The plan with measured bias bounds: each effect that is on is left out once, with its dependents."""
    if plan.closed_form:
        return plan
    pilot = Pilot(job, plan)

    def measure(effect: EffectDecision) -> EffectDecision:
        if not effect.on or not effect.present:
            return effect
        cut = without(plan, effect.name)
        others = plan.names_on - cut.names_on - {effect.name}
        removed = ", ".join(e.description for name, e in EFFECTS.items() if name in others)
        text = f"; the bound includes {removed}" if removed else ""
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
