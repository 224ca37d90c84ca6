"""``mbtf-gen inspect``: what a material is."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.console import CONSOLE, Console
from mbtf_core.shard_schema import Tiling
from mbtf_gen.cli.common import Set, general, resolve_config


def inspect(
    material: str | None = None,
    /,
    *,
    height_scale: float | None = None,
    mesh: int | None = None,
    make_tileable: Tiling | None = None,
    config: Path | None = None,
    assignments: Set | None = None,
    console: Console = CONSOLE,
) -> None:
    """Say what a material holds and what each map will do: sizes, relief, slopes, tiling, albedo, oddities.

    Parameters
    ----------
    material
        Height map, folder of maps, or material.yaml.
    height_scale
        Factor on the stored heights, in tile widths. Default: the material's own
    mesh
        Mesh cells across the tile. Default: the map's width, at most 512
    make_tileable
        For maps that do not tile: 2 x 2 mirrored copies, or cross-faded edges. Default: none
    config
        YAML file with the options.
    """
    from mbtf_gen.config.generator import GeneratorConfig
    from mbtf_gen.material.inspect import inspect_material
    from mbtf_gen.material.inspect_text import inspection_text
    from mbtf_gen.material.material import load_material

    flags = general(
        height_scale=height_scale,
        mesh=mesh,
        make_tileable=make_tileable,
        light_width=None,
        max_depth=None,
        seed=None,
    )
    resolved = resolve_config(GeneratorConfig, material, config, assignments or [], flags)
    geometry = resolved.geometry
    loaded = load_material(resolved.material, geometry.make_tileable)
    found = {"material": resolved.material, **inspect_material(loaded, geometry.height_scale, geometry.mesh)}
    console.report(found, inspection_text(found, resolved.material))
