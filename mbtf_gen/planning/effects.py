"""The effects plan: which effects of light a run simulates, why, and what leaving the others out costs.

The cost of leaving an effect out is the root mean square, over the run's queries, of the change that it makes
to M, relative to the mean of M. Costs of several effects add up to no less than that of leaving out all of
them (Minkowski), so a tolerance can be shared out.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from mbtf_core.errors import UsageError
from mbtf_gen.planning.sample_allocation import Allocation

# Effects by name, in the order in which light meets them, and what they are called.
EFFECTS: dict[str, str] = {
    "masking": "parallax and masking",
    "shadowing": "shadowing",
    "interreflection": "interreflection",
    "neighbors": "periodic neighbors",
    "specular": "specular lobe",
    "metallic": "metallic",
    "coat": "clear coat",
    "sheen": "sheen",
    "normal": "normal map",
    "opacity": "opacity",
    "fibers": "fiber scattering",
    "mis": "BSDF sampling of light",
}
# Those that only a displaced tile has.
OF_RELIEF = ("masking", "shadowing", "interreflection", "neighbors")

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


@dataclass(frozen=True)
class EffectsRequest:
    """What was asked for: ``auto``, ``all`` or ``none``, and effects forced on or off."""

    base: Literal["auto", "all", "none"]
    forced: dict[str, bool]

    @classmethod
    def parse(cls, text: str) -> EffectsRequest:
        """Read ``auto``, ``all``, ``none``, ``+x``, ``-x``, or a comma-separated list of them.

        Raises
        ------
        UsageError : an unknown word
        """
        base: Any = "auto"
        forced: dict[str, bool] = {}
        for position, word in enumerate(w.strip() for w in text.split(",")):
            if position == 0 and word in ("auto", "all", "none"):
                base = word
            elif word[:1] in ("+", "-") and word[1:] in EFFECTS:
                forced[word[1:]] = word[0] == "+"
            else:
                raise UsageError(
                    f"'{word}' is no effect",
                    where="--effects",
                    hint=f"auto, all or none, then +x or -x with x of {', '.join(EFFECTS)}",
                )
        return cls(base, forced)

    def decide(self, effect: Effect) -> Effect:
        """The effect as it was asked for, where it was.

        Raises
        ------
        UsageError : asked for by name, but the material does not have it; or asked away, but it stays
        """
        name = effect.name
        if not effect.present:
            asked = self.forced.get(name, effect.on)
            if asked and not effect.on:
                raise UsageError(f"the material has none: {effect.reason}", where=f"--effects +{name}")
            if effect.on and not asked:
                raise UsageError(f"cannot be left out: {effect.reason}", where=f"--effects -{name}")
            return effect
        on = self.forced.get(name, effect.on if self.base == "auto" else self.base == "all")
        if on == effect.on:
            return effect
        return replace(effect, on=on, reason=f"asked {'for' if on else 'away'}; {effect.reason}")
