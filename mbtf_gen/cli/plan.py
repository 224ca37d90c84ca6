"""``mbtf-gen plan``: which effects a run would simulate, why, and the bias of leaving each one out."""

from __future__ import annotations

import math
import textwrap
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from mbtf_core.console import CONSOLE, Console
from mbtf_core.options import Options, PathText, takes_options
from mbtf_gen.cli.generate import prepare_job
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.config.presets import QualityOption

if TYPE_CHECKING:
    from mbtf_gen.effects.effect import EffectDecision
    from mbtf_gen.effects.plan import EffectsPlan

# Columns of the table before the explanation, and its width.
_NAME, _BOUND, _WIDTH = 24, 24, 108


@takes_options(GeneratorConfig)
def plan(
    material: PathText | None = None,
    /,
    *,
    quality: QualityOption = None,
    options: Options[GeneratorConfig],
    measure: Annotated[bool, Parameter(show_default=False)] = True,
    console: Console = CONSOLE,
) -> None:
    """Report which effects of light a run would simulate and why, and forecast its time, size and noise.

    The bias bound of an effect is the root mean square change of M over the run's queries if the effect is
    left out, in percent of its mean value. The forecast is measured by a pilot run on this machine.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, or file of yarns or fibers.
    measure
        Measure the bias of omitting each simulated effect by a pilot run, and forecast the run.
    """
    from mbtf_gen.job import split_target
    from mbtf_gen.planning.effects_planner import plan_effects

    job = prepare_job(options, material, quality)
    found = plan_effects(job)
    if not measure:
        console.report({**found.to_manifest(), "forecast": None}, table(found))
        return
    from mbtf_gen.forecast import forecast
    from mbtf_gen.planning.pilot import measured
    from mbtf_gen.planning.run_plan import allocate

    expected = forecast(job, allocate(job, found))
    found = measured(job, found)
    text = f"{table(found)}\n{expected.describe(split_target(job.config, 'train'))}"
    console.report({**found.to_manifest(), "forecast": asdict(expected)}, text)


def table(plan: EffectsPlan) -> str:
    """The plan as a table, a line or two per effect."""
    from mbtf_gen.effects.catalog import EFFECTS

    before = _NAME + 5 + _BOUND
    lines = [f"{'effect':<{_NAME}}{'':5}{'bias bound if omitted':<{_BOUND}}reason"]
    for e in plan.effects:
        first, *rest = textwrap.wrap(e.explanation, _WIDTH - before) or [""]
        state = "on" if e.on else "off"
        lines.append(f"{EFFECTS[e.name].description:<{_NAME}}{state:<5}{bound_text(e):<{_BOUND}}{first}")
        lines += [" " * before + more for more in rest]
    bound = plan.bias_bound
    share = "0 %" if bound == 0 else f"at most {_percent(bound)}"
    lines.append(f"bias of all omitted effects: {share}; effects.tolerance is {_percent(plan.tolerance)}")
    if plan.closed_form:
        lines.append("M has a closed form: no paths are traced")
    elif plan.max_depth:
        lines.append(f"paths end after {plan.max_depth} surface interactions")
    return "\n".join(lines)


def bound_text(effect: EffectDecision) -> str:
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
