"""``mbtf-gen inspect``: what a material is."""

from __future__ import annotations

from mbtf_core.console import CONSOLE, Console
from mbtf_core.options import Options, takes_options
from mbtf_gen.cli.generate import resolve_config
from mbtf_gen.config.generator import GeneratorConfig


@takes_options(GeneratorConfig, "geometry")
def inspect(
    material: str | None = None,
    /,
    *,
    options: Options[GeneratorConfig],
    console: Console = CONSOLE,
) -> None:
    """Describe a material and each of its maps: sizes, heights, slopes, tiling, albedo, warnings.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    """
    from mbtf_gen.material.inspect import inspect_material, inspection_text
    from mbtf_gen.material.material import load_material

    resolved = resolve_config(options, material)
    geometry = resolved.geometry
    loaded = load_material(resolved.material, geometry.make_tileable)
    if loaded.bsdf is not None:
        from mbtf_gen.render.runtime import load_mitsuba

        load_mitsuba()
        from mbtf_gen.render.scene import build_tile

        # Mitsuba refuses what it does not know.
        build_tile(loaded.grid(mesh=1), loaded.bsdf)
    found = {"material": resolved.material, **inspect_material(loaded, geometry.height_scale, geometry.mesh)}
    console.report(found, inspection_text(found, resolved.material))
