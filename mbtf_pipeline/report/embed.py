"""Images as ``data:`` URIs, within a size limit."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import to_display, white_of
from mbtf_pipeline.report.error_maps import Palette, indices, palette

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Pixels = NDArray[np.floating]
# Quality of images of files.
_QUALITY = 86


def shrink(values: Pixels, factor: int) -> Pixels:
    """Average `factor` × `factor` pixels of (rows, columns, ...); incomplete blocks are dropped."""
    if factor == 1:
        return values
    factor = min(factor, *values.shape[:2])
    rows, columns = (n // factor for n in values.shape[:2])
    cut = values[: rows * factor, : columns * factor]
    out: Pixels = cut.reshape(rows, factor, columns, factor, *values.shape[2:]).mean(axis=(1, 3))
    return out


@dataclass(frozen=True)
class Encoding:
    """How images are reduced for the report.

    Attributes
    ----------
    shrink : downsampling factor
    shades : colors of a map
    """

    shrink: int = 1
    shades: int = 256

    def describe(self) -> str:
        """Text for the page."""
        reductions = [f"{self.shrink} × {self.shrink} pixels averaged"] if self.shrink > 1 else []
        reductions += [f"maps in {self.shades} shades"] if self.shades < 256 else []
        return f"PNG, reduced to limit the file size: {', '.join(reductions)}" if reductions else "PNG"


# From best quality to smallest size.
ENCODINGS = (Encoding(), Encoding(1, 64), *(Encoding(shrink, 32) for shrink in (1, 2, 4, 8, 16)))


def _data_uri(image: Any, kind: str, **options: int) -> str:
    stream = io.BytesIO()
    image.save(stream, kind, optimize=True, **options)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"


def jpeg_uri(display: U8, quality: int) -> str:
    """``data:`` URI of an 8-bit sRGB image as JPEG."""
    from PIL import Image

    return _data_uri(Image.fromarray(display), "jpeg", quality=quality, subsampling=0)


def png_uri(display: U8) -> str:
    """``data:`` URI of an 8-bit sRGB image as PNG."""
    from PIL import Image

    return _data_uri(Image.fromarray(display), "png")


def file_uri(path: Path, most: int | None = None) -> str:
    """``data:`` URI of an image file as JPEG, shrunk to so many pixels along a side at most.

    Raises
    ------
    OSError : missing or corrupt
    """
    from PIL import Image

    with Image.open(path) as image:
        small = image.convert("RGB")
    if most is not None:
        small.thumbnail((most, most))
    return jpeg_uri(np.asarray(small), _QUALITY)


def map_uri(values: Pixels, name: Palette, shades: int) -> str:
    """``data:`` URI of a map (rows, columns) as PNG with `shades` colors of a palette."""
    from PIL import Image

    steps = np.round(indices(values, name) * ((shades - 1) / 255.0))
    image = Image.fromarray(np.round(steps * (255.0 / (shades - 1))).astype(np.uint8))
    image.putpalette([channel for color in palette(name) for channel in color])
    return _data_uri(image, "png")


@dataclass
class Gallery:
    """Images of the page by name.

    Attributes
    ----------
    exposure : of the linear images, in EV
    linear : images (rows, columns, 3) in 1/sr
    maps : palettes and maps (rows, columns), scaled to [0, 1] or, if signed, to [-1, 1]
    """

    exposure: float
    linear: dict[str, F32] = field(default_factory=dict)
    maps: dict[str, tuple[Palette, Pixels]] = field(default_factory=dict)

    @property
    def white(self) -> float:
        """Linear value displayed as white, 1/sr."""
        return white_of(self.exposure)


def encode(gallery: Gallery, encoding: Encoding) -> dict[str, str]:
    """``data:`` URIs of a gallery's images by name; linear ones at its exposure."""
    images = {
        name: png_uri(to_display(shrink(picture, encoding.shrink), gallery.exposure))
        for name, picture in gallery.linear.items()
    }
    for name, (colors, values) in gallery.maps.items():
        images[name] = map_uri(shrink(values, encoding.shrink), colors, encoding.shades)
    return images
