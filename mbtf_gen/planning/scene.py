"""A run while it is planned: what effects of light know of it, propose, and decide."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import UsageError
from mbtf_gen.planning.bounds import Change, DisplacementBounds
from mbtf_gen.planning.job import Job
from mbtf_gen.tile.heights import triangle_slopes
from mbtf_gen.tile.maps.material_file import REFLECTING
from mbtf_gen.tile.protocol import Tile

F64 = NDArray[np.float64]
Reason = Literal["exact", "bound", "pilot", "forced"]
Stage = Literal["reflection", "maps", "transport"]


@dataclass(frozen=True)
class EffectDecision:
    """The decision on one effect.

    Attributes
    ----------
    name, on, explanation : the effect, whether it is simulated, and why
    bias_bound : root mean square change of M without the effect, relative to the mean of M: an upper bound
        where the effect is off, an estimate where it is on; None where it is unknown
    reason : what the decision rests on: the material and the options alone (``exact``), a bound from theory,
        a pilot or an estimate on the maps, or the user's request (``forced``)
    present : whether the effect can be switched; if not, the material lacks it or requires it
    error : standard error of a measured bias bound
    """

    name: str
    on: bool
    explanation: str
    bias_bound: float | None = None
    reason: Reason = "exact"
    present: bool = True
    error: float = 0.0


@dataclass(frozen=True)
class EffectsRequest:
    """The user's request (``--effects``): ``auto``, ``all`` or ``none``, and effects forced on or off."""

    base: Literal["auto", "all", "none"]
    forced: dict[str, bool]

    @classmethod
    def parse(cls, text: str, names: Collection[str]) -> EffectsRequest:
        """Read ``auto``, ``all``, ``none``, ``+x``, ``-x``, or a comma-separated list of them; `names` are
        those of all effects. A UsageError names an unknown word."""
        base: Any = "auto"
        forced: dict[str, bool] = {}
        for position, word in enumerate(w.strip() for w in text.split(",")):
            if position == 0 and word in ("auto", "all", "none"):
                base = word
            elif word[:1] in ("+", "-") and word[1:] in names:
                forced[word[1:]] = word[0] == "+"
            else:
                raise UsageError(
                    f"'{word}' is not an effect",
                    where="--effects",
                    hint=f"auto, all or none, then +x or -x with x of {', '.join(names)}",
                )
        return cls(base, forced)

    def decide(self, effect: EffectDecision) -> EffectDecision:
        """The effect, switched where the user requests it; a UsageError if the request switches an effect on
        that the material lacks, or off one that it requires."""
        name = effect.name
        if not effect.present:
            requested = self.forced.get(name, effect.on)
            if requested and not effect.on:
                raise UsageError(f"the material has none: {effect.explanation}", where=f"--effects +{name}")
            if effect.on and not requested:
                raise UsageError(f"cannot be left out: {effect.explanation}", where=f"--effects -{name}")
            return effect
        on = self.forced.get(name, effect.on if self.base == "auto" else self.base == "all")
        if on == effect.on:
            return effect
        explanation = f"forced {'on' if on else 'off'}; {effect.explanation}"
        return replace(effect, on=on, explanation=explanation, reason="forced")


class Pilots(Protocol):
    """Small runs of the generator that measure changes for :class:`PlanScene`."""

    def change_without(self, name: str, proposals: Mapping[str, EffectDecision]) -> Change:
        """Change when an effect is left out of the decisions so far and `proposals`."""

    def change_of_layer(self, name: str, strength: float) -> Change:
        """Change when a layer is left out whose strength is scaled to one."""

    def capped(self, proposals: Mapping[str, EffectDecision]) -> Callable[[int], Change]:
        """Function from a limit of surface interactions to the change under it."""


@dataclass
class PlanScene:
    """A run while it is planned: facts about it, and what is decided so far.

    Attributes
    ----------
    job, request : the run, and the user's request for effects
    pilots : measure changes; None in small runs and for reference pictures
    decided : decisions so far
    bounds : bias bounds of a displaced Lambert surface; None where they do not apply
    undisplaced : why there is no displaced surface, and what that rests on; None where there is one
    cap, cap_bound : limit of surface interactions, 0 for none; its bias bound
    left : bias that may still be added; effects that are left out reduce it
    lambert : whether only the base color reflects, or nothing else is on
    mapped : slopes that the normal map adds, and the share of the mesh's slopes that it repeats; None without
    """

    job: Job
    request: EffectsRequest
    pilots: Pilots | None = None
    decided: dict[str, EffectDecision] = field(default_factory=dict)
    bounds: DisplacementBounds | None = None
    undisplaced: tuple[str, Reason] | None = None
    cap_bound: float = 0.0

    def __post_init__(self) -> None:
        config, tile = self.job.config, self.job.material
        self.light_width, self.min_cos = config.light.width, config.queries.min_cos
        self.max_depth = self.cap = config.transport.max_depth
        self.normal_mode = config.effects.normal
        self.left = config.effects.tolerance
        self.lambert = tile.is_lambert and not set(REFLECTING) & tile.maps.keys()
        self.mapped = tile.normal_slopes(config.effects.normal)

    @property
    def tile(self) -> Tile:
        """The tile."""
        return self.job.material

    @cached_property
    def albedo(self) -> F64:
        """(h, w, 3) base color; 1 where a BSDF replaces it."""
        if self.tile.bsdf_type is not None:
            return np.ones((1, 1, 3))
        base = np.asarray(self.tile.base_color, np.float64)
        return base.reshape(*(base.shape[:-1] or (1, 1)), 3)

    @cached_property
    def steepest(self) -> float:
        """Largest slope of any triangle, the tangent of its angle to the plane; infinite without heights."""
        grid = self.tile.grid
        return np.inf if grid is None else float(triangle_slopes(grid).max())

    @cached_property
    def passing(self) -> F64 | None:
        """(h, w) share of the rays that the opacity mask lets through; None if all is opaque."""
        opacity = self.tile.maps.get("opacity")
        if opacity is None or self.tile.bsdf_type is not None or np.all(np.asarray(opacity) == 1.0):
            return None
        return 1.0 - np.atleast_2d(np.asarray(opacity, np.float64))

    @property
    def flat(self) -> bool:
        """Whether nothing is displaced: the point of a ray follows from the height map's plane alone."""
        return self.tile.grid is not None and self.tile.thickness == 0.0

    def is_auto(self, name: str) -> bool:
        """Whether the plan decides on an effect, because the user requests nothing of it."""
        return self.request.base == "auto" and name not in self.request.forced

    def share_out(self, proposals: dict[str, EffectDecision]) -> None:
        """Decide on effects together; those with the smallest bias bounds are left out while the sum is
        within the tolerance."""
        bounded = [(d.bias_bound, n) for n, d in proposals.items() if d.on and d.bias_bound is not None]
        tolerance = self.left
        for bound, name in sorted(bounded, key=lambda one: one[0]):
            if bound > tolerance:
                break
            proposals[name] = replace(proposals[name], on=False)
            tolerance -= bound
        self.decided |= {name: self.request.decide(decision) for name, decision in proposals.items()}
        off = (decision.bias_bound or 0.0 for decision in self.decided.values() if not decision.on)
        self.left = self.job.config.effects.tolerance - sum(off)


class Effect(ABC):
    """An effect of light.

    Attributes
    ----------
    name, description : as users write it, and in words
    stage : when it is decided: how the surface reflects, what maps add, how light travels
    switch : field of :class:`~mbtf_gen.render.path_tracer.Transport` that it sets; empty for none
    alters_tile : whether the tile's shape or surface is another without it
    displaced : whether it needs the displaced surface
    order : when it is decided among those of the stage ``transport``: what is left of the tolerance passes
        from one to the next, and pilots need the decisions before them
    """

    name: ClassVar[str]
    description: ClassVar[str]
    stage: ClassVar[Stage]
    switch: ClassVar[str] = ""
    alters_tile: ClassVar[bool] = False
    displaced: ClassVar[bool] = False
    order: ClassVar[int] = 0

    @abstractmethod
    def propose(self, scene: PlanScene) -> EffectDecision:
        """Whether to simulate the effect, before the user's request counts."""

    def reference(self, scene: PlanScene) -> EffectDecision:
        """The same for reference pictures, which simulate all that the material has."""
        return self.propose(scene)

    def decision(
        self,
        on: bool,
        explanation: str,
        bias_bound: float | None = None,
        reason: Reason = "exact",
        *,
        present: bool = True,
    ) -> EffectDecision:
        """A decision on this effect."""
        return EffectDecision(self.name, on, explanation, bias_bound, reason, present)
