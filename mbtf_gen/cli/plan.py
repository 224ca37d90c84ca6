"""``mbtf-gen plan``: which effects a run would simulate, why, and the bias of leaving each one out."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from cyclopts import Parameter

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import PathText, QualityOption
from mbtf_gen.cli.generate import GenerateOptions, prepare_job


def plan(
    material: PathText | None = None,
    /,
    *,
    quality: QualityOption = None,
    options: GenerateOptions = GenerateOptions(),  # noqa: B008
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
    from mbtf_gen.planning.run_plan import plan_effects

    job = prepare_job(options, material, quality)
    found = plan_effects(job)
    if not measure:
        console.report({**found.to_manifest(), "forecast": None}, found.describe())
        return
    from mbtf_gen.forecast import forecast
    from mbtf_gen.planning.run_plan import allocate, measured

    expected = forecast(job, allocate(job, found))
    found = measured(job, found)
    text = f"{found.describe()}\n{expected.describe(split_target(job.config, 'train'))}"
    console.report({**found.to_manifest(), "forecast": asdict(expected)}, text)
