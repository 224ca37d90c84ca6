"""The effects plan as a table for people."""

from __future__ import annotations

import math
import textwrap

from mbtf_gen.effects.catalog import EFFECTS
from mbtf_gen.effects.effect import EffectDecision
from mbtf_gen.effects.plan import EffectsPlan

# Columns of the table before the explanation, and its width.
_NAME, _BOUND, _WIDTH = 24, 24, 108


def plan_table(plan: EffectsPlan) -> str:
    """The plan as a table, a line or two per effect."""
    before = _NAME + 5 + _BOUND
    lines = [f"{'effect':<{_NAME}}{'':5}{'bias bound if omitted':<{_BOUND}}reason"]
    for e in plan.effects:
        first, *rest = textwrap.wrap(e.explanation, _WIDTH - before) or [""]
        state = "on" if e.on else "off"
        lines.append(f"{EFFECTS[e.name].description:<{_NAME}}{state:<5}{_bound_text(e):<{_BOUND}}{first}")
        lines += [" " * before + more for more in rest]
    bound = plan.bias_bound
    share = "0 %" if bound == 0 else f"at most {_percent(bound)}"
    lines.append(f"bias of all omitted effects: {share}; effects.tolerance is {_percent(plan.tolerance)}")
    if plan.closed_form:
        lines.append("M has a closed form: no paths are traced")
    elif plan.max_depth:
        lines.append(f"paths end after {plan.max_depth} surface interactions")
    return "\n".join(lines)


def _bound_text(effect: EffectDecision) -> str:
    """The bias bound of leaving an effect out, with its error or as an upper bound."""
    if effect.bias_bound is None:
        return "-"
    if effect.reason == "exact" and effect.bias_bound == 0:
        return "0 (exact)"
    if effect.reason == "bound" or not effect.on:
        return f"< {_percent(effect.bias_bound)}"
    if effect.error:
        if effect.bias_bound < 2.0 * effect.error:
            return f"< {_percent(effect.bias_bound + 2 * effect.error)}"
        return f"{_percent(effect.bias_bound)[:-2]} ± {_percent(effect.error, 1)}"
    return f"~ {_percent(effect.bias_bound)}"


def _percent(share: float, digits: int = 2) -> str:
    """A share in percent, rounded to some digits but written out."""
    percent = 100.0 * share
    if percent <= 0.0:
        return "0 %"
    places = digits - 1 - math.floor(math.log10(percent))
    return f"{round(percent, places):.{max(0, places)}f} %"
