"""The effects plan: which effects of light a run simulates, and how much bias leaving out the others may add.

The bias bound of an effect is an upper bound on the root mean square change of M over the run's queries when
the effect is left out, relative to the mean of M. Bounds of several effects add up to at least the bound of
leaving out all of them (Minkowski's inequality), so a tolerance can be divided among them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from mbtf_core.errors import UsageError
from mbtf_gen.config.effects_request import DISPLACEMENT_EFFECTS, EFFECTS, EffectsRequest

Reason = Literal["exact", "bound", "pilot", "forced"]


@dataclass(frozen=True)
class Effect:
    """The decision on one effect.

    Attributes
    ----------
    name : str
        A key of ``EFFECTS``.
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
class EffectsPlan:
    """Decisions on all effects, in the order of ``EFFECTS``.

    Attributes
    ----------
    effects : tuple of Effect
        One decision per effect.
    max_depth : int
        Surface interactions of a path at most; 0 means no limit.
    cap_bias_bound : float
        Bias bound of that limit, where the plan chose it.
    roulette_depth : int
        Surface interactions before Russian roulette begins.
    mode : str
        The user's request.
    tolerance : float
        Allowed bias bound of everything that is left out together.
    closed_form : bool
        Whether M is known without tracing.
    """

    effects: tuple[Effect, ...]
    max_depth: int = 0
    cap_bias_bound: float = 0.0
    roulette_depth: int = 1
    mode: str = "auto"
    tolerance: float = 0.0
    closed_form: bool = False

    def __getitem__(self, name: str) -> Effect:
        return next(e for e in self.effects if e.name == name)

    def on(self, name: str) -> bool:
        """Whether an effect is simulated."""
        return self[name].on

    @property
    def names_on(self) -> frozenset[str]:
        """Names of the effects that are simulated."""
        return frozenset(e.name for e in self.effects if e.on)

    @property
    def bias_bound(self) -> float:
        """Bias bound of everything that is left out together, relative to the mean of M."""
        return self.cap_bias_bound + sum(e.bias_bound or 0.0 for e in self.effects if not e.on)

    def to_manifest(self) -> dict[str, Any]:
        """Plain data for the manifest."""
        effects = [asdict(effect) for effect in self.effects]
        return {**vars(self), "bias_bound": self.bias_bound, "effects": effects}


def decide(request: EffectsRequest, effect: Effect) -> Effect:
    """The effect, switched where the user requests it.

    Raises
    ------
    UsageError : the request switches an effect on that the material lacks, or off one that it requires
    """
    name = effect.name
    if not effect.present:
        requested = request.forced.get(name, effect.on)
        if requested and not effect.on:
            raise UsageError(f"the material has none: {effect.explanation}", where=f"--effects +{name}")
        if effect.on and not requested:
            raise UsageError(f"cannot be left out: {effect.explanation}", where=f"--effects -{name}")
        return effect
    on = request.forced.get(name, effect.on if request.base == "auto" else request.base == "all")
    if on == effect.on:
        return effect
    explanation = f"forced {'on' if on else 'off'}; {effect.explanation}"
    return replace(effect, on=on, explanation=explanation, reason="forced")


def consistent(decided: dict[str, Effect], request: EffectsRequest) -> dict[str, Effect]:
    """Decisions by name, where effects that need the displaced surface are off without it.

    Raises
    ------
    UsageError : the request forces such an effect on
    """
    out = dict(decided)
    if out["parallax"].on:
        return out
    needed = EFFECTS["parallax"]
    for name in DISPLACEMENT_EFFECTS[1:]:
        if out[name].on:
            if request.forced.get(name):
                raise UsageError(f"'{EFFECTS[name]}' needs '{needed}'", where=f"--effects +{name}")
            out[name] = replace(out[name], on=False, explanation=f"needs {needed}")
    return out


def without(plan: EffectsPlan, name: str) -> EffectsPlan:
    """The plan without an effect and without those that need it.

    Raises
    ------
    UsageError : the material requires the effect
    """
    request = EffectsRequest("auto", {name: False})
    decided = consistent({e.name: decide(request, e) for e in plan.effects}, request)
    return replace(plan, effects=tuple(decided.values()))
