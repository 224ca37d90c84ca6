"""The effects plan: which effects of light a run simulates, and how much bias leaving out the others may add.

The bias bound of an effect is an upper bound on the root mean square change of M over the run's queries when
the effect is left out, relative to the mean of M. Bounds of several effects add up to at least the bound of
leaving out all of them (Minkowski's inequality), so a tolerance can be divided among them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from mbtf_core.errors import UsageError
from mbtf_gen.effects.catalog import EFFECTS
from mbtf_gen.effects.effect import EffectDecision
from mbtf_gen.effects.request import EffectsRequest


@dataclass(frozen=True)
class EffectsPlan:
    """Decisions on all effects, in the order of ``EFFECTS``.

    Attributes
    ----------
    effects : tuple of EffectDecision
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

    effects: tuple[EffectDecision, ...]
    max_depth: int = 0
    cap_bias_bound: float = 0.0
    roulette_depth: int = 1
    mode: str = "auto"
    tolerance: float = 0.0
    closed_form: bool = False

    def __getitem__(self, name: str) -> EffectDecision:
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


def decide(request: EffectsRequest, effect: EffectDecision) -> EffectDecision:
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


def consistent(decided: dict[str, EffectDecision], request: EffectsRequest) -> dict[str, EffectDecision]:
    """Decisions by name, where effects that need the displaced surface are off without it.

    Raises
    ------
    UsageError : the request forces such an effect on
    """
    out = dict(decided)
    if out["parallax"].on:
        return out
    needed = EFFECTS["parallax"].description
    for name, effect in EFFECTS.items():
        if effect.displaced and name != "parallax" and out[name].on:
            if request.forced.get(name):
                raise UsageError(f"'{effect.description}' needs '{needed}'", where=f"--effects +{name}")
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
