"""The effects plan: which effects of light a run simulates, and how much bias leaving out the others may add.

The bias bound of an effect is an upper bound on the root mean square change of M over the run's queries when
the effect is left out, relative to the mean of M. Bounds of several effects add up to at least the bound of
leaving out all of them (Minkowski's inequality), so a tolerance can be divided among them.
"""

from __future__ import annotations

import textwrap
from dataclasses import asdict, dataclass, replace
from typing import Any

from mbtf_core.errors import UsageError
from mbtf_core.units import percent
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.scene import EffectDecision, EffectsRequest

# Columns of the table before the explanation, and its width.
_NAME, _BOUND, _WIDTH = 24, 24, 108


@dataclass(frozen=True)
class EffectsPlan:
    """Decisions on all effects, in the order of ``EFFECTS``.

    Attributes
    ----------
    effects : one decision per effect
    max_depth : surface interactions of a path at most; 0 means no limit
    cap_bias_bound : bias bound of that limit, where the plan chose it
    roulette_depth : surface interactions before Russian roulette begins
    mode : the user's request
    tolerance : allowed bias bound of everything that is left out together
    closed_form : whether M is known without tracing
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

    def describe(self) -> str:
        """A table for people, a line or two per effect."""
        before = _NAME + 5 + _BOUND
        lines = [f"{'effect':<{_NAME}}{'':5}{'bias if omitted':<{_BOUND}}reason"]
        for e in self.effects:
            first, *rest = textwrap.wrap(e.explanation, _WIDTH - before) or [""]
            state = "on" if e.on else "off"
            lines.append(f"{EFFECTS[e.name].description:<{_NAME}}{state:<5}{bias_text(e):<{_BOUND}}{first}")
            lines += [" " * before + more for more in rest]
        bound = self.bias_bound
        share = "0%" if bound == 0 else f"at most {percent(bound)}"
        lines.append(f"bias of all omitted effects: {share}; effects.tolerance is {percent(self.tolerance)}")
        if self.closed_form:
            lines.append("M has a closed form: no paths are traced")
        elif self.max_depth:
            lines.append(f"paths end after {self.max_depth} surface interactions")
        return "\n".join(lines)


def consistent(decided: dict[str, EffectDecision], request: EffectsRequest) -> dict[str, EffectDecision]:
    """Decisions by name, where effects that need the displaced surface are off without it; a UsageError if
    the request forces such an effect on."""
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
    """The plan without an effect and without those that need it; a UsageError if the material requires it."""
    request = EffectsRequest("auto", {name: False})
    decided = consistent({e.name: request.decide(e) for e in plan.effects}, request)
    return replace(plan, effects=tuple(decided.values()))


def bias_text(effect: EffectDecision) -> str:
    """The bias of leaving an effect out, as :func:`bound_text`."""
    if effect.reason == "exact" and effect.bias_bound == 0:
        return "0 (exact)"
    return "unknown" if effect.bias_bound is None else bound_text(effect.bias_bound, effect.error)


def bound_text(bound: float, error: float | None) -> str:
    """An upper bound of a bias relative to the mean of M, as text: with two standard errors where it is
    measured, and no number above 100%, which would only mean that nothing is known."""
    upper = bound + 2.0 * (error or 0.0)
    return "may exceed 100%" if upper >= 1.0 else f"< {percent(upper)}"
