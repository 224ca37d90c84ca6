"""Maps as image files: PNG, colors in sRGB, all other numbers linear."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import linear_to_srgb
from mbtf_core.files.atomic import write_chunks
from mbtf_fit.material.interchange.maps import Maps

BASE_COLOR, NORMAL, ORM, HEIGHT = "base_color.png", "normal.png", "roughness_metallic.png", "height.png"


def _bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def _write(path: Path, pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    import imagecodecs

    write_chunks(path, [imagecodecs.png_encode(np.ascontiguousarray(pixels), level=9)])


def write_maps(maps: Maps, folder: Path) -> list[str]:
    """Write the maps of a material and return their names.

    - ``base_color.png``: sRGB; with opacity as its alpha where there are holes.
    - ``normal.png``: normals n as (n + 1) / 2; x along u, which is right in the image, y along v, up.
    - ``roughness_metallic.png``: green roughness, blue metallic, red 1.
    - ``height.png``: 16 bits, 0 the lowest and 65535 the highest vertex; the range is in the document. Models
      that know no surface have none.
    """
    color = linear_to_srgb(maps.base_color)
    if maps.opacity.min() < 1.0:
        color = np.concatenate([color, maps.opacity[..., None]], -1)
    _write(folder / BASE_COLOR, _bytes(color))
    _write(folder / NORMAL, _bytes(0.5 * maps.normals + 0.5))
    ones = np.ones_like(maps.roughness)
    _write(folder / ORM, _bytes(np.stack([ones, maps.roughness, maps.metallic], -1)))
    if maps.heights is None:
        return [BASE_COLOR, NORMAL, ORM]
    share = (maps.heights - maps.heights.min()) / (height_range(maps) or 1.0)
    _write(folder / HEIGHT, np.rint(share * 65535.0).astype(np.uint16))
    return [BASE_COLOR, NORMAL, ORM, HEIGHT]


def height_range(maps: Maps) -> float:
    """Highest minus lowest vertex, in tile widths; 0 without heights."""
    return 0.0 if maps.heights is None else float(np.ptp(maps.heights))


def has_holes(maps: Maps) -> bool:
    """Whether the base color has an alpha channel."""
    return bool(maps.opacity.min() < 1.0)
