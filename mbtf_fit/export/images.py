"""Maps as images (base color, normal, roughness and metallic in one, height), and what documents share."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_core.extras import extra_error, has_extra
from mbtf_core.files.atomic import write_file, write_text
from mbtf_core.paths import real_path
from mbtf_fit.export import Export, ExportTarget, flags

if TYPE_CHECKING:
    from mbtf_fit.maps.maps import Maps

BASE_COLOR, NORMAL, ORM, HEIGHT = "base_color.png", "normal.png", "roughness_metallic.png", "height.png"
COAT = "clearcoat.png"
IMAGE_NAMES = (BASE_COLOR, NORMAL, ORM, HEIGHT, COAT)


@flags("Map")
@dataclass(frozen=True)
class MapOptions:
    """Options of maps.

    Attributes
    ----------
    level
        Level of the maps; default: the finest.
    """

    level: int | None = None


def document_target(
    name: str, help: str, file: str, text: Callable[[Maps, str, dict[str, Any]], str], module: str
) -> ExportTarget:
    """The target that writes the maps of a material as images, once for all documents of an export, and a
    document.

    Parameters
    ----------
    file : name of the document
    text : of maps, the material's name, and plain data that identify the neural material and the maps
    module : the library that makes the document
    """

    def write(export: Export, options: MapOptions) -> list[str]:
        if not has_extra(module):
            raise extra_error(module, file)
        if "maps" not in export.shared:
            from mbtf_fit.maps.maps import make_maps

            maps, unexplained = make_maps(export.material, options.level, export.console)
            export.shared["maps"] = maps, write_images(maps, export.folder)
            export.notes.append(f"{maps}; unexplained variance against the material {unexplained}")
            export.report["maps"] = {**maps.as_dict(), "unexplained": unexplained.as_dict()}
        maps, images = export.shared["maps"]
        described = {
            "neural_material": Path(os.path.relpath(export.source, export.folder)).as_posix(),
            "model": export.material.model.name,
            "weights_sha256": export.material.description["weights"]["sha256"],
            "level": maps.level,
            **({} if maps.heights is None else {"height_range_in_tile_widths": round(maps.height_range, 9)}),
        }
        write_text(export.folder / file, text(maps, real_path(export.source).name, described))
        return [*images, file]

    return ExportTarget(name, help, [file, *IMAGE_NAMES], write, MapOptions)


def write_images(maps: Maps, folder: Path) -> list[str]:
    """Write maps as PNG, colors in sRGB, all other numbers linear, and return their names.

    - ``base_color.png``: with opacity as its alpha where there are holes.
    - ``normal.png``: normals n as (n + 1) / 2; x along u, which is right in the image, y along v, up.
    - ``roughness_metallic.png``: green roughness, blue metallic, red 1.
    - ``clearcoat.png``, of coated surfaces: red weight, green roughness of the clear coat.
    - ``height.png``: 16 bits, 0 the lowest and 65535 the highest vertex; the range is in the document. Models
      that know no surface have none.
    """
    from PIL import Image

    from mbtf_core.color import linear_to_srgb

    color = linear_to_srgb(maps.base_color)
    if maps.has_holes:
        color = np.concatenate([color, maps.opacity[..., None]], -1)
    packed = np.stack([np.ones_like(maps.roughness), maps.roughness, maps.metallic], -1)
    images = {BASE_COLOR: color, NORMAL: 0.5 * maps.normals + 0.5, ORM: packed}
    if maps.coat is not None:
        images[COAT] = np.concatenate([maps.coat, np.zeros_like(maps.coat[..., :1])], -1)
    if maps.heights is not None:
        images[HEIGHT] = (maps.heights - maps.heights.min()) / (maps.height_range or 1.0)
    for name, image in images.items():
        kind = np.uint16 if name == HEIGHT else np.uint8
        pixels = np.rint(np.clip(image, 0.0, 1.0) * np.iinfo(kind).max).astype(kind)
        write_file(folder / name, partial(Image.fromarray(pixels).save, format="PNG", compress_level=9))
    return list(images)
