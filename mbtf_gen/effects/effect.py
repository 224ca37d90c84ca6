"""What an effect of light is, and what it may ask while a run is planned."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Reason = Literal["exact", "bound", "pilot", "forced"]
Stage = Literal["reflection", "maps", "transport"]


@dataclass(frozen=True)
class EffectDecision:
    """The decision on one effect.

    Attributes
    ----------
    name : str
        Name of the effect.
    on : bool
        Whether the effect is simulated.
    explanation : str
        Why, in words.
    bias_bound : float or None
        Root mean square change of M without the effect, relative to the mean of M: an upper bound where the
        effect is off, an estimate where it is on. None where it is unknown.
    reason : {"exact", "bound", "pilot", "forced"}
        What the decision rests on: the material and the options alone, a bound from theory, a pilot or an
        estimate on the maps, or the user's request.
    present : bool
        Whether the effect can be switched. If not, the material lacks it or requires it.
    error : float
        Standard error of a measured bias bound.
    """

    name: str
    on: bool
    explanation: str
    bias_bound: float | None = None
    reason: Reason = "exact"
    present: bool = True
    error: float = 0.0


@dataclass(frozen=True)
class DisplacementBounds:
    """Bias bounds of leaving out effects of a displaced Lambert surface, relative to the mean value.

    Attributes
    ----------
    parallax : the plane, shaded with the mesh's slopes and without shadows, replaces the displaced tile
    shadowing : no shadows on the displaced tile
    normal : shading without the given residual slopes
    opacity : surface and occluders opaque everywhere
    """

    parallax: float
    shadowing: float
    normal: float
    opacity: float


class TileFacts(Protocol):
    """What effects ask of a tile, see :class:`mbtf_gen.tile.protocol.Tile`."""

    kind: ClassVar[str]

    @property
    def maps(self) -> Mapping[str, Any]:
        """Maps and constants by role."""

    @property
    def bsdf_type(self) -> str | None:
        """Type of the BSDF that replaces the maps."""

    @property
    def is_lambert(self) -> bool:
        """Whether the base layer is Lambert."""

    @property
    def scatters(self) -> bool:
        """Whether light passes through the matter itself."""

    @property
    def thickness(self) -> float:
        """Displacement range in tile widths."""

    @property
    def grid(self) -> Any:
        """The heights; None for tiles that are no height field."""

    def narrowest_lobe(self) -> tuple[float, str] | None:
        """(width in radians, what it is of) of the narrowest lobe."""


class MeasuredChange(Protocol):
    """What a pilot measured, see :class:`mbtf_gen.planning.pilot.Change`."""

    @property
    def rms(self) -> float:
        """Root mean square change, relative to the mean value."""

    def bound(self, most: float = np.inf) -> float:
        """Upper bound of the root mean square change."""


class PlanScene(Protocol):
    """A run while it is planned: facts about it, what is decided so far, and pilots.

    Attributes
    ----------
    tile : the tile; lambert : whether only its base color reflects, or nothing else is on
    albedo : (h, w, 3) reflectance of a Lambert surface
    light_width, min_cos, max_depth, normal_mode : options of the run
    mapped : slopes that the normal map adds, and the share of the mesh's slopes that it repeats; None
        without
    passing : (h, w) share of the rays that the opacity mask lets through; None without
    bounds : bias bounds of a displaced Lambert surface; None where they do not apply
    pilots : whether pilots may run
    auto : effects that the plan decides, because the user requests nothing of them
    left : bias that may still be added; effects that are left out reduce it
    undisplaced : why there is no displaced surface, and what that rests on; None where there is one
    cap, cap_bound : limit of surface interactions, 0 for none; its bias bound
    """

    @property
    def tile(self) -> TileFacts: ...

    lambert: bool
    light_width: float
    min_cos: float
    max_depth: int
    normal_mode: str
    mapped: tuple[F64, float] | None
    bounds: DisplacementBounds | None
    pilots: bool
    auto: frozenset[str]
    left: float
    undisplaced: tuple[str, Reason] | None
    cap: int
    cap_bound: float

    @property
    def albedo(self) -> F64: ...

    @property
    def passing(self) -> F64 | None: ...

    @property
    def flat(self) -> bool:
        """Whether nothing is displaced."""

    @property
    def steepest(self) -> float:
        """Largest slope of any triangle, the tangent of its angle to the plane; infinite without heights."""

    def is_on(self, name: str) -> bool:
        """Whether an effect that is decided already is simulated."""

    def change_without(self, name: str, proposals: Mapping[str, EffectDecision]) -> MeasuredChange:
        """Change when an effect is left out of the decisions so far and `proposals`, by a pilot."""

    def change_of_layer(self, name: str, strength: float) -> MeasuredChange:
        """Change when a layer is left out whose strength is scaled to one, by a pilot."""

    def capped(self, proposals: Mapping[str, EffectDecision]) -> Callable[[int], MeasuredChange]:
        """Function from a limit of surface interactions to the change under it, by pilots."""


class Effect(ABC):
    """An effect of light.

    Attributes
    ----------
    name, description : str
        As users write it, and in words.
    stage : {"reflection", "maps", "transport"}
        When it is decided: how the surface reflects, what maps add, how light travels.
    switch : str
        Field of :class:`~mbtf_gen.render.path_tracer.Transport` that it sets; empty for none.
    alters_tile : bool
        Whether the tile's shape or surface is another without it.
    displaced : bool
        Whether it needs the displaced surface.
    order : int
        When it is decided among those of the stage ``transport``: what is left of the tolerance passes from
        one to the next, and pilots need the decisions before them.
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
