"""``mbtf-gen plan``: which effects a run would simulate, why, and the bias of leaving each one out."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from mbtf_core.console import CONSOLE, Console
from mbtf_core.shard_schema import Tiling
from mbtf_gen.cli.common import QualityOption, Set, general, resolve_config
from mbtf_gen.config.presets import GENERATOR, as_assignments
from mbtf_gen.config.quality_measured import expected as expected_of

if TYPE_CHECKING:
    from mbtf_gen.planning.effects import Effect, EffectsPlan

# Columns of the table before the explanation, and its width.
_NAME, _BOUND, _WIDTH = 24, 24, 108


def plan(
    material: str | None = None,
    /,
    *,
    quality: QualityOption | None = None,
    queries: str | None = None,
    spp: int | None = None,
    target_error: str | None = None,
    effects: str | None = None,
    tolerance: float | None = None,
    height_scale: float | None = None,
    mesh: int | None = None,
    make_tileable: Tiling | None = None,
    light_width: float | None = None,
    min_cos: float | None = None,
    max_depth: int | None = None,
    seed: int | None = None,
    measure: bool = True,
    config: Path | None = None,
    assignments: Set | None = None,
    console: Console = CONSOLE,
) -> None:
    """Show which effects of light a run would simulate, why, and the bias of leaving each one out.

    The bias is the root mean square change of M over the run's queries, in percent of the mean value. A pilot
    on this machine also predicts the run's time, disk space and noise.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    queries
        Training queries of the run that is forecast: N, or N/texel of the finest level. Default: 100/texel
    spp
        Paths per training query, both halves together (even). Default: 4
    target_error
        Error of every training value to reach, relative to max(value, tile mean), such as 2%.
    effects
        auto, all, none, then +x or -x: effects of light to simulate. Default: auto
    tolerance
        Bias bound of all effects left out together, relative to the mean value. Default: 0.005
    height_scale
        Factor on the stored heights, in tile widths. Default: the material's own
    mesh
        Mesh cells across the tile. Default: the map's width, at most 512
    make_tileable
        For maps that do not tile: 2 x 2 mirrored copies, or cross-faded edges. Default: none
    light_width
        RMS angle of the light per axis in degrees; 0 is a delta light. Default: 1
    min_cos
        Smallest cosine of light and view directions to the normal. Default: 0.1
    max_depth
        Surface interactions per path; 0: no limit (Russian roulette). Default: 0
    seed
        Root seed. Default: 0
    measure
        Measure the bias of leaving out each effect that is on, and forecast the run.
    config
        YAML file with the options.
    """
    from mbtf_gen.config.generator import GeneratorConfig

    flags = {
        "--queries": ("queries.train", queries),
        "--spp": ("queries.spp", spp),
        "--target-error": ("queries.target_error", target_error),
        "--effects": ("effects.mode", effects),
        "--tolerance": ("effects.tolerance", tolerance),
        "--min-cos": ("queries.min_cos", min_cos),
        **general(
            height_scale=height_scale,
            mesh=mesh,
            make_tileable=make_tileable,
            light_width=light_width,
            max_depth=max_depth,
            seed=seed,
        ),
    }
    assigned = [*as_assignments(GENERATOR[quality] if quality else {}), *(assignments or [])]
    resolved = resolve_config(GeneratorConfig, material, config, assigned, flags)
    from mbtf_gen.job import Job, split_target
    from mbtf_gen.planning.effects_plan import plan_effects

    job = Job.prepare(resolved)
    found = plan_effects(job)
    if not measure:
        console.report({**found.to_manifest(), "forecast": None}, table(found))
        return
    from mbtf_gen.forecast import forecast
    from mbtf_gen.planning.pilot import measured
    from mbtf_gen.planning.run_plan import allocate

    expected = forecast(job, allocate(job, found))
    found = measured(job, found)
    data = {**found.to_manifest(), "forecast": expected.as_dict()}
    text = f"{table(found)}\n{expected.describe(split_target(job.config, 'train'))}"
    if quality is not None and (measured_line := expected_of().line(quality)) is not None:
        text += (
            f"\nwhole runs to material and report on {expected_of().machine}, {expected_of().resolution} "
            f"texels across: {measured_line}"
        )
    console.report(data, text)


def table(plan: EffectsPlan) -> str:
    """The plan as a table, a line or two per effect."""
    lines = [f"{'effect':<{_NAME}}{'':5}{'bias bound if left out':<{_BOUND}}why"]
    for effect in plan.effects:
        lines += _row(effect)
    bound = plan.bias_bound
    share = "0 %" if bound == 0 else f"at most {_percent(bound)}"
    lines.append(f"bias of all that is off: {share}, tolerance {_percent(plan.tolerance)} (--tolerance)")
    if plan.closed_form:
        lines.append("M has a closed form: no paths are traced")
    elif plan.max_depth:
        lines.append(f"paths end after {plan.max_depth} surface interactions")
    return "\n".join(lines)


def _row(effect: Effect) -> list[str]:
    from mbtf_gen.config.effects_request import EFFECTS

    before = _NAME + 5 + _BOUND
    why = textwrap.wrap(effect.explanation, _WIDTH - before) or [""]
    first = f"{EFFECTS[effect.name]:<{_NAME}}{'on' if effect.on else 'off':<5}{bound_text(effect):<{_BOUND}}"
    return [first + why[0], *(" " * before + more for more in why[1:])]


def bound_text(effect: Effect) -> str:
    """The bias bound of leaving an effect out, with its error or as an upper bound."""
    if effect.bias_bound is None:
        return "-"
    if effect.reason == "exact" and effect.bias_bound == 0:
        return "0 exactly"
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
    places = max(0, digits - 1 - math.floor(math.log10(percent)))
    return f"{round(percent, digits - 1 - math.floor(math.log10(percent))):.{places}f} %"
