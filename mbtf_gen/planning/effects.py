"""The effects plan: which effects of light a run simulates, why, and what leaving the others out costs.

The cost of leaving an effect out is the root mean square, over the run's queries, of the change that it makes
to M, relative to the mean of M. Costs of several effects add up to no less than that of leaving out all of
them (Minkowski), so a tolerance can be shared out.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from mbtf_core.errors import UsageError
from mbtf_gen.config.effects_request import EFFECTS, EffectsRequest
from mbtf_gen.planning.sample_allocation import Allocation

# How a cost is known: it follows exactly; it is bounded from above by theory; it was measured by a pilot; or
# the effect was asked for, or asked away, and nobody looked.
Known = Literal["exact", "bound", "pilot", "asked"]


@dataclass(frozen=True)
class Effect:
    """A decision.

    Attributes
    ----------
    name : key of :data:`EFFECTS`
    on : simulated or not
    reason : in words
    cost : of leaving it out, relative to the mean value; None where it was not worked out
    known : how the cost is known
    error : standard error of a measured cost
    present : the material has what the effect needs, and it is ours to switch; otherwise it stays as it is
    """

    name: str
    on: bool
    reason: str
    cost: float | None = None
    known: Known = "asked"
    present: bool = True
    error: float = 0.0


@dataclass(frozen=True)
class EffectsPlan:
    """Decisions on every effect of :data:`EFFECTS`, in that order.

    Attributes
    ----------
    max_depth : cap on surface interactions per path; 0 for none
    cap_cost : cost of that cap where the plan chose it
    roulette_depth : interactions before Russian roulette begins
    mode : what was asked for
    tolerance : allowed cost of all effects left out together
    closed_form : M is known without tracing anything
    allocation : which queries get how many paths; None where all get the same
    """

    effects: tuple[Effect, ...]
    max_depth: int = 0
    cap_cost: float = 0.0
    roulette_depth: int = 1
    mode: str = "auto"
    tolerance: float = 0.0
    closed_form: bool = False
    allocation: Allocation | None = None

    def __getitem__(self, name: str) -> Effect:
        return next(e for e in self.effects if e.name == name)

    def on(self, name: str) -> bool:
        """Is an effect simulated?"""
        return self[name].on

    @property
    def cost(self) -> float:
        """Cost of everything left out together, at most; relative to the mean value."""
        return self.cap_cost + sum(e.cost or 0.0 for e in self.effects if not e.on)

    def to_manifest(self) -> dict[str, Any]:
        """Plain data for the manifest."""
        effects = [{"effect": EFFECTS[e.name], **asdict(e)} for e in self.effects]
        return {
            "mode": self.mode,
            "tolerance": self.tolerance,
            "cost": self.cost,
            "max_depth": self.max_depth,
            "cap_cost": self.cap_cost,
            "roulette_depth": self.roulette_depth,
            "closed_form": self.closed_form,
            "allocation": None if self.allocation is None else self.allocation.to_manifest(),
            "effects": effects,
        }

    @classmethod
    def from_manifest(cls, data: dict[str, Any]) -> EffectsPlan:
        """Inverse of :meth:`to_manifest`."""
        effects = tuple(Effect(**{k: v for k, v in e.items() if k != "effect"}) for e in data["effects"])
        names = ("max_depth", "cap_cost", "roulette_depth", "mode", "tolerance", "closed_form")
        stored = data["allocation"]
        allocation = None if stored is None else Allocation.from_manifest(stored)
        return cls(effects, **{name: data[name] for name in names}, allocation=allocation)


def decide(request: EffectsRequest, effect: Effect) -> Effect:
    """The effect as it was asked for, where it was.

    Raises
    ------
    UsageError : asked for by name, but the material does not have it; or asked away, but it stays
    """
    name = effect.name
    if not effect.present:
        asked = request.forced.get(name, effect.on)
        if asked and not effect.on:
            raise UsageError(f"the material has none: {effect.reason}", where=f"--effects +{name}")
        if effect.on and not asked:
            raise UsageError(f"cannot be left out: {effect.reason}", where=f"--effects -{name}")
        return effect
    on = request.forced.get(name, effect.on if request.base == "auto" else request.base == "all")
    if on == effect.on:
        return effect
    return replace(effect, on=on, reason=f"asked {'for' if on else 'away'}; {effect.reason}")
