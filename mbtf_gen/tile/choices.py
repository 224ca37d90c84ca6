"""Material files of what ``mbtf-gen inspect --write`` found and chose; other commands then need no flags."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.errors import UsageError
from mbtf_core.files.atomic import write_text
from mbtf_core.files.folders import make_folder
from mbtf_core.images.color_spaces import ColorSpace
from mbtf_core.paths import named_file, real_path
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.heightfield_tile import HeightFieldTile
from mbtf_gen.tile.loading import described
from mbtf_gen.tile.maps.material_file import MAX_SCALE, MaterialFile
from mbtf_gen.tile.maps.tiling import broken
from mbtf_gen.tile.protocol import Tile


@dataclass(frozen=True)
class Choice:
    """A value that a material file stores, and where it comes from."""

    value: Any
    reason: str


def _shown(spec: MaterialFile, material: HeightFieldTile) -> Iterator[tuple[str, Choice]]:
    """What the maps show where the file says nothing, by dotted key of a material file."""
    fit = material.normal_fit
    if spec.height.scale is None:
        default = f"{material.height_scale:g}"
        if fit is not None and fit.fits and 0 < abs(fit.scale) <= MAX_SCALE:
            reason = f"suggested by the normal map; the default would be {default}"
            yield "height.scale", Choice(float(f"{fit.scale:.3g}"), reason)
        elif material.unit_fault() is None:
            yield "height.scale", Choice(material.height_scale, "the default; no normal map suggests one")
    if spec.make_tileable is None:
        axes = " and ".join(seam.axis for seam in material.seams if broken(seam))
        choice = Choice("blend", f"the heights do not tile along {axes}")
        if not axes:
            choice = Choice("none", "the heights tile")
        elif any(role.startswith("bsdf.") for role in material.files):
            choice = Choice("none", "textures of a bsdf cannot be blended")
        yield "make_tileable", choice
    if spec.normal is not None and spec.normal.convention is None:
        decided = fit is not None and fit.convention is not None
        reason = "as the heights' slopes show" if decided else "by its name or assumed"
        yield "normal.convention", Choice(material.normal_convention, reason)
    if (color := spec.base_color) is not None and color.file is not None and color.colorspace is None:
        space = material.facts["base_color"].colorspace
        # Another declared space is converted only where none is given.
        if space in get_args(ColorSpace):
            yield "base_color.colorspace", Choice(space, "as its file is read")


def write_material_file(path: Path, material: Tile, config: GeneratorConfig) -> dict[str, Choice]:
    """Write a material file with given values, else those of the present file, else what the maps show; its
    file names are relative to it.

    Parameters
    ----------
    path : the file; replaced if it exists
    material : loaded as `config` says
    config : names the material; its options of the geometry and its resolution are given

    Returns
    -------
    dict of str to Choice
        The values that the present file does not hold, by dotted key.

    Raises
    ------
    InputError, PartialError : the file cannot be written
    """
    spec, folder, _ = described(Path(config.material))
    if not isinstance(spec, MaterialFile):
        raise UsageError("is for height maps, not for fibers and triangles", where="--write")
    # The tile of a material file is a height field.
    choices = dict(_shown(spec, cast(HeightFieldTile, material)))
    given = {
        "height.scale": config.geometry.height_scale,
        "make_tileable": config.geometry.make_tileable,
        "resolution": config.queries.resolution,
    }
    choices |= {name: Choice(value, "given") for name, value in given.items() if value is not None}
    make_folder(path.parent)
    source, target = real_path(folder), real_path(path.parent)

    def moved(node: Any, key: str = "") -> Any:
        if isinstance(node, dict):
            return {name: moved(value, name) for name, value in node.items()}
        names_file = key in ("file", "filename") and isinstance(node, str)
        return Path(os.path.relpath(named_file(source, node), target)).as_posix() if names_file else node

    # Plain types, without what a YAML reader attaches.
    data = moved(json.loads(json.dumps(spec.model_dump(mode="json", exclude_defaults=True))))
    for name, choice in choices.items():
        section, _, key = name.rpartition(".")
        (data[section] if section else data)[key] = choice.value
    write_text(path, f"# Written by mbtf-gen inspect. Flags override it.\n{dump_yaml(data)}")
    return choices
