"""``mbtf-gen plan``: which effects a run would simulate, why, and what leaving the others out costs."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console
from mbtf_core.options import Options, takes_options
from mbtf_gen.cli.common import resolve_config
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.config.presets import GENERATOR, QualityOption, as_assignments

if TYPE_CHECKING:
    from mbtf_gen.planning.effects import Effect, EffectsPlan

# Columns of the table before the reason, and its width.
_NAME, _COST, _WIDTH = 24, 18, 100


@takes_options(GeneratorConfig)
def plan(
    material: str | None = None,
    /,
    *,
    quality: QualityOption = None,
    options: Options[GeneratorConfig],
    measure: Annotated[bool, Parameter(show_default=False)] = True,
    console: Console = CONSOLE,
) -> None:
    """Report which effects of light a run would simulate and why, and forecast its time, size and noise.

    The bias bound of an effect is the root mean square change of M over the run's queries if the effect is
    left out, in percent of its mean value. A pilot on this machine gives the forecast.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    measure
        Measure the bias of leaving out each simulated effect by a small run, and forecast the run.
    """
    resolved = resolve_config(options, material, as_assignments(GENERATOR[quality] if quality else {}))
    from mbtf_gen.generation import Job
    from mbtf_gen.planning.effects_plan import plan_effects
    from mbtf_gen.planning.pilot import measured

    job = Job.prepare(resolved)
    found = plan_effects(job)
    if not measure:
        console.report({**found.to_manifest(), "forecast": None}, table(found))
        return
    from mbtf_gen.forecast import forecast
    from mbtf_gen.generation import allocated

    expected = forecast(job, allocated(job, found))
    found = measured(job, found)
    data = {**found.to_manifest(), "forecast": expected.as_dict()}
    text = f"{table(found)}\n{expected.describe(job.target('train'))}"
    console.report(data, text)


def table(plan: EffectsPlan) -> str:
    """The plan as a table, a line or two per effect."""
    lines = [f"{'effect':<{_NAME}}{'':5}{'cost if left out':<{_COST}}why"]
    for effect in plan.effects:
        lines += _row(effect)
    left = plan.cost
    share = "nothing" if left == 0 else f"at most {_percent(left)}"
    lines.append(f"left out together: {share}, of {_percent(plan.tolerance)} allowed (effects.tolerance)")
    if plan.closed_form:
        lines.append("M is known in closed form: nothing is traced")
    elif plan.max_depth:
        lines.append(f"paths end after {plan.max_depth} surface interactions")
    return "\n".join(lines)


def _row(effect: Effect) -> list[str]:
    from mbtf_gen.config.effects_request import EFFECTS

    before = _NAME + 5 + _COST
    reason = textwrap.wrap(effect.reason, _WIDTH - before) or [""]
    first = f"{EFFECTS[effect.name]:<{_NAME}}{'on' if effect.on else 'off':<5}{cost_text(effect):<{_COST}}"
    return [first + reason[0], *(" " * before + more for more in reason[1:])]


def cost_text(effect: Any) -> str:
    """The cost of leaving an effect out, and how it is known."""
    if effect.cost is None:
        return "-"
    if effect.known == "exact" and effect.cost == 0:
        return "0 exactly"
    if effect.known == "bound" or (effect.known == "pilot" and not effect.on):
        return f"< {_percent(effect.cost)}"
    if effect.error:
        low = effect.cost < 2.0 * effect.error
        if low:
            return f"< {_percent(effect.cost + 2 * effect.error)}"
        return f"{_percent(effect.cost)[:-2]} ± {_percent(effect.error, 1)}"
    return f"~ {_percent(effect.cost)}"


def _percent(share: float, digits: int = 2) -> str:
    """A share in percent, rounded to some digits but written out."""
    percent = 100.0 * share
    if percent <= 0.0:
        return "0 %"
    places = max(0, digits - 1 - math.floor(math.log10(percent)))
    return f"{round(percent, digits - 1 - math.floor(math.log10(percent))):.{places}f} %"
