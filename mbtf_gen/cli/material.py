"""``mbtf-gen inspect`` and ``mbtf-gen plan``: what a material is, and what a run would simulate of it."""

from __future__ import annotations

from dataclasses import asdict

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Options, PathText, QualityOption, options_from
from mbtf_core.errors import UsageError
from mbtf_core.paths import split_url
from mbtf_gen.cli.generate import GenerateOptions, prepare_job, resolve_config
from mbtf_gen.config.generator import GeneratorConfig


@options_from(GeneratorConfig, "geometry", "queries.resolution")
class InspectOptions(Options[GeneratorConfig]):
    """Options of ``mbtf-gen inspect``."""


def inspect(
    material: PathText | None = None,
    /,
    *,
    options: InspectOptions = InspectOptions(),  # noqa: B008
    console: Console = CONSOLE,
) -> None:
    """Describe a material and each of its maps.

    It prints sizes, heights, slopes, tiling, albedo and warnings.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, yarns or fibers.
    """
    if split_url(material) is not None:
        hint = f"describe a data set with: mbtf-fit info {material}"
        raise UsageError("is a URL, but materials are local files", where=material, hint=hint)
    resolved = resolve_config(options, material)
    from mbtf_gen.tile.inspection import inspection_text
    from mbtf_gen.tile.loading import load_material

    geometry = resolved.geometry
    loaded = load_material(resolved.material, geometry.make_tileable, geometry.max_pixels)
    if loaded.bsdf_type is not None:
        from mbtf_gen.engine.runtime import load_mitsuba

        load_mitsuba()
        from mbtf_gen.render.scene import load_surface

        # Mitsuba refuses what it does not know.
        load_surface(loaded.surface(()))
    found = {"material": resolved.material, **loaded.inspect(geometry, resolved.queries.finest)}
    console.report(found, inspection_text(found, resolved.material))


def plan(
    material: PathText | None = None,
    /,
    *,
    quality: QualityOption = None,
    options: GenerateOptions = GenerateOptions(),  # noqa: B008
    console: Console = CONSOLE,
) -> None:
    """Forecast a run: effects of light, time, size and noise.

    It says which effects the run would simulate, and why. The bias bound of an effect is the root mean square
    change of M over the run's queries if the effect is left out, in percent of its mean value. The forecast
    is measured by a pilot run on this machine.

    Parameters
    ----------
    material
        Height map, folder of maps, material.yaml, mesh, yarns or fibers.
    """
    from mbtf_gen.planning.forecast import forecast
    from mbtf_gen.planning.job import split_target
    from mbtf_gen.planning.run_plan import allocate, measured, plan_effects, skips_pilots

    job = prepare_job(options, material, quality)
    job.announce_briefly()
    found = plan_effects(job, pilots=not skips_pilots(job))
    expected = forecast(job, allocate(job, found))
    found = measured(job, found)
    text = f"{found.describe()}\n{expected.describe(split_target(job.config, 'train'))}"
    console.report({**found.to_manifest(), "forecast": asdict(expected)}, text)
