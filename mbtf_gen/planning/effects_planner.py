"""Decides the effects plan: every effect proposes, the user's request counts, and a tolerance is divided."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.effects.catalog import EFFECTS
from mbtf_gen.effects.effect import DisplacementBounds, EffectDecision, Reason, Stage
from mbtf_gen.effects.plan import EffectsPlan, consistent, decide, without
from mbtf_gen.effects.request import EffectsRequest
from mbtf_gen.job import Job
from mbtf_gen.planning.bounds import POINTS, displacement_bounds
from mbtf_gen.planning.pilot import Change, Pilot, pilot_queries
from mbtf_gen.sampling.light_kernel import LightKernel
from mbtf_gen.tile.heights import triangle_slopes
from mbtf_gen.tile.maps.material_file import REFLECTING
from mbtf_gen.tile.protocol import Tile


def plan_effects(job: Job, *, pilots: bool = True) -> EffectsPlan:
    """Decide which effects a run simulates.

    Parameters
    ----------
    job : Job
        Configuration and material.
    pilots : bool
        Whether pilots measure where theory gives no bound. Otherwise such effects stay on.

    Returns
    -------
    EffectsPlan

    Raises
    ------
    UsageError
        The user requests an effect that the material lacks, or that needs one switched off.
    """
    request = EffectsRequest.parse(job.config.effects.mode)
    scene = PlannedScene(job, request, pilots, request.auto)
    scene.share_out("reflection")
    if not any(decision.on for decision in scene.decided.values()):
        scene.lambert = True
    scene.bounds = _displacement_bounds(scene)
    scene.share_out("maps")
    black = not scene.albedo.any() and scene.lambert and not scene.is_on("opacity")
    if scene.flat or black:
        scene.undisplaced = ("flat" if scene.flat else "black: reflects nothing"), "exact"
    travel = (effect for effect in EFFECTS.values() if effect.stage == "transport")
    for effect in sorted(travel, key=lambda effect: effect.order):
        scene.decided[effect.name] = decide(request, effect.propose(scene))
    plan = scene.plan()
    if request.base != "all" and _has_closed_form(scene, plan):
        plan = replace(plan, closed_form=True)
    return replace(plan, mode=job.config.effects.mode, tolerance=job.config.effects.tolerance)


def reference_plan(job: Job) -> EffectsPlan:
    """The plan of reference pictures: all effects that the material has, whatever their size."""
    request = EffectsRequest.parse(job.config.effects.mode)
    scene = PlannedScene(job, request, False, frozenset())
    scene.decided = {name: decide(request, effect.reference(scene)) for name, effect in EFFECTS.items()}
    return replace(scene.plan(), mode=job.config.effects.mode)


@dataclass
class PlannedScene:
    """A run while it is planned, see :class:`mbtf_gen.effects.effect.PlanScene`.

    Attributes
    ----------
    job, request : the run, and the user's request for effects
    decided : decisions so far
    """

    job: Job
    request: EffectsRequest
    pilots: bool
    auto: frozenset[str]
    decided: dict[str, EffectDecision] = field(default_factory=dict)
    bounds: DisplacementBounds | None = None
    undisplaced: tuple[str, Reason] | None = None
    cap_bound: float = 0.0

    def __post_init__(self) -> None:
        config, tile = self.job.config, self.job.material
        self.light_width, self.min_cos = config.light.width, config.queries.min_cos
        self.max_depth = self.cap = config.transport.max_depth
        self.normal_mode: str = config.effects.normal
        self.left = config.effects.tolerance
        self.lambert = tile.is_lambert and not set(REFLECTING) & tile.maps.keys()
        self.mapped = tile.normal_slopes(config.effects.normal)

    @property
    def tile(self) -> Tile:
        """The tile."""
        return self.job.material

    @cached_property
    def albedo(self) -> NDArray[np.float64]:
        """(h, w, 3) base color; 1 where a BSDF replaces it."""
        if self.tile.bsdf_type is not None:
            return np.ones((1, 1, 3))
        base = np.asarray(self.tile.base_color, np.float64)
        return base.reshape(*(base.shape[:-1] or (1, 1)), 3)

    @cached_property
    def steepest(self) -> float:
        """Largest slope of any triangle; infinite for tiles that are no height field."""
        grid = self.tile.grid
        return np.inf if grid is None else float(triangle_slopes(grid).max())

    @cached_property
    def passing(self) -> NDArray[np.float64] | None:
        """(h, w) share of the rays that pass through; None if all is opaque."""
        opacity = self.tile.maps.get("opacity")
        if opacity is None or self.tile.bsdf_type is not None or np.all(np.asarray(opacity) == 1.0):
            return None
        return 1.0 - np.atleast_2d(np.asarray(opacity, np.float64))

    @property
    def flat(self) -> bool:
        """Whether nothing is displaced."""
        return self.tile.thickness == 0.0

    def is_on(self, name: str) -> bool:
        """Whether an effect that is decided already is simulated."""
        return self.decided[name].on

    def share_out(self, stage: Stage) -> None:
        """Decide the effects of a stage; those with the smallest bias bounds are left out while the sum is
        within the tolerance."""
        found = {name: e.propose(self) for name, e in EFFECTS.items() if e.stage == stage}
        bounded = [(d.bias_bound, name) for name, d in found.items() if d.on and d.bias_bound is not None]
        tolerance = self.left
        for bound, name in sorted(bounded, key=lambda one: one[0]):
            if bound > tolerance:
                break
            found[name] = replace(found[name], on=False)
            tolerance -= bound
        self.decided |= {name: decide(self.request, decision) for name, decision in found.items()}
        off = (decision.bias_bound or 0.0 for decision in self.decided.values() if not decision.on)
        self.left = self.job.config.effects.tolerance - sum(off)

    def plan(self, proposals: Mapping[str, EffectDecision] | None = None) -> EffectsPlan:
        """The plan of the decisions so far, and of proposals in place of some."""
        extra = {name: decide(self.request, decision) for name, decision in (proposals or {}).items()}
        decided = consistent({**self.decided, **extra}, self.request)
        effects = tuple(decided[name] for name in EFFECTS)
        return EffectsPlan(effects, self.cap, self.cap_bound, self.job.config.transport.roulette_depth)

    def change_without(self, name: str, proposals: Mapping[str, EffectDecision]) -> Change:
        """Change when an effect is left out, by a pilot."""
        plan = self.plan(proposals)
        return Pilot(self.job, plan).changed(without(plan, name))

    def change_of_layer(self, name: str, strength: float) -> Change:
        """Change when a layer is left out whose strength is scaled to one, by a pilot."""
        full = np.asarray(self.tile.maps[name]) / strength
        job = Job.of(self.job.config, self.tile.with_maps(**{name: full}))
        plan = reference_plan(job)
        return Pilot(job, plan).changed(without(plan, name))

    def capped(self, proposals: Mapping[str, EffectDecision]) -> Callable[[int], Change]:
        """Change under a limit of surface interactions, by pilots with one kernel."""
        return Pilot(self.job, self.plan(proposals)).limited


def _displacement_bounds(scene: PlannedScene) -> DisplacementBounds | None:
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


def _has_closed_form(scene: PlannedScene, plan: EffectsPlan) -> bool:
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
