"""Material files of what ``mbtf-gen inspect --write`` found and chose; other commands then need no flags."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.schema import Tiling
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

_GIVEN, _FILE = "given", "as in the material file"


@dataclass(frozen=True)
class Choice:
    """A value that a material file stores, and where it comes from."""

    value: Any
    reason: str


def choose(spec: MaterialFile, material: HeightFieldTile, config: GeneratorConfig) -> dict[str, Choice]:
    """Choices by key of a material file: given ones, else those of the file, else what the maps show.

    Parameters
    ----------
    spec : the material as described
    material : the same, loaded
    config : its options of the geometry and its resolution are given ones

    Returns
    -------
    dict of str to Choice
        By dotted key; without those that nothing decides.
    """
    out = {
        "make_tileable": _tiling(spec, material, config.geometry.make_tileable),
    }
    if (scale := _height_scale(spec, material, config.geometry.height_scale)) is not None:
        out = {"height.scale": scale, **out}
    if material.normal_convention is not None:
        shown = material.normal_fit is not None and material.normal_fit.convention is not None
        source = "as the heights' slopes show" if shown else "by its name or assumed"
        asked = spec.normal is not None and spec.normal.convention is not None
        out["normal.convention"] = Choice(material.normal_convention, _FILE if asked else source)
    if (color := spec.base_color) is not None and color.file is not None:
        source, space = "as its file is read", material.facts["base_color"].colorspace
        # Another declared space is converted only where none is given.
        if space in get_args(ColorSpace):
            out["base_color.colorspace"] = Choice(space, _FILE if color.colorspace is not None else source)
    if (given := config.queries.resolution) is not None:
        out["resolution"] = Choice(given, _GIVEN)
    elif spec.resolution is not None:
        out["resolution"] = Choice(spec.resolution, _FILE)
    return out


def _height_scale(spec: MaterialFile, material: HeightFieldTile, given: float | None) -> Choice | None:
    if given is not None:
        return Choice(given, _GIVEN)
    if spec.height.scale is not None:
        return Choice(spec.height.scale, _FILE)
    default, fit = material.height_scale, material.normal_fit
    if fit is not None and fit.fits and 0 < abs(fit.scale) <= MAX_SCALE:
        return Choice(
            float(f"{fit.scale:.3g}"), f"suggested by the normal map; the default would be {default:g}"
        )
    if material.unit_fault() is not None:
        return None
    return Choice(default, "the default; no normal map suggests one")


def _tiling(spec: MaterialFile, material: HeightFieldTile, given: Tiling | None) -> Choice:
    if given is not None:
        return Choice(given, _GIVEN)
    if spec.make_tileable is not None:
        return Choice(spec.make_tileable, _FILE)
    axes = [seam.axis for seam in material.seams if broken(seam)]
    if not axes:
        return Choice("none", "the heights tile")
    if any(role.startswith("bsdf.") for role in material.files):
        return Choice("none", "textures of a bsdf cannot be blended")
    return Choice("blend", f"the heights do not tile along {' and '.join(axes)}")


def write_material_file(path: Path, material: Tile, config: GeneratorConfig) -> dict[str, Choice]:
    """Write a material file with :func:`choose`'s choices; its file names are relative to it.

    Parameters
    ----------
    path : the file; replaced if it exists
    material : loaded as `config` says
    config : names the material, and the options that were given

    Returns
    -------
    dict of str to Choice
        The choices.

    Raises
    ------
    InputError, PartialError : the file cannot be written
    """
    spec, folder, _ = described(Path(config.material))
    if not isinstance(spec, MaterialFile):
        raise UsageError("is for height maps, not for fibers and triangles", where="--write")
    # The tile of a material file is a height field.
    choices = choose(spec, cast(HeightFieldTile, material), config)
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
