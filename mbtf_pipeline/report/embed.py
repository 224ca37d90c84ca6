"""Images as ``data:`` URIs and compressed linear data, within a size limit."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.exposure import to_display, white_of
from mbtf_pipeline.report.error_maps import Palette, indices, palette
from mbtf_pipeline.report.linear_images import Coding, pack

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
    """How images are stored in the report.

    Attributes
    ----------
    bits : per channel of a logarithmic code
    quality : of the JPEG previews
    shrink : downsampling factor
    preview_shrink : additional downsampling factor of the previews
    shades : colors of a map
    """

    bits: int
    quality: int
    shrink: int = 1
    preview_shrink: int = 1
    shades: int = 256

    def describe(self, coding: Coding) -> str:
        """Text for the page."""
        data = (
            f"{self.bits} bits per channel on a logarithmic scale (error at most {coding.relative_error:.1%})"
        )
        reductions = [f"{self.shrink} × {self.shrink} pixels averaged"] if self.shrink > 1 else []
        reductions += [f"maps in {self.shades} shades"] if self.shades < 256 else []
        return f"{data}; reduced to limit the file size: {', '.join(reductions)}" if reductions else data


# From best quality to smallest size.
ENCODINGS = (
    Encoding(10, 88),
    Encoding(9, 82),
    Encoding(9, 80, preview_shrink=2, shades=64),
    *(Encoding(8, 75, shrink, preview_shrink=2, shades=32) for shrink in (1, 2, 4, 8, 16)),
)


def _data_uri(image: Any, kind: str, **options: int) -> str:
    stream = io.BytesIO()
    image.save(stream, kind, optimize=True, **options)
    return f"data:image/{kind};base64,{base64.b64encode(stream.getvalue()).decode()}"


def jpeg_uri(display: U8, quality: int) -> str:
    """``data:`` URI of an 8-bit sRGB image as JPEG."""
    from PIL import Image

    return _data_uri(Image.fromarray(display), "jpeg", quality=quality, subsampling=0)


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


def encode(
    gallery: Gallery, encoding: Encoding
) -> tuple[Coding, dict[str, str], dict[str, dict[str, int | str]]]:
    """Encode a gallery.

    Returns
    -------
    coding : of all linear images
    images : ``data:`` URIs of maps, and of linear images, by name
    packed : rows, columns and data of linear images by name
    """
    coding = Coding.spanning(gallery.linear.values(), gallery.white, encoding.bits)
    images: dict[str, str] = {}
    packed: dict[str, dict[str, int | str]] = {}
    for name, picture in gallery.linear.items():
        small = shrink(picture, encoding.shrink).astype(np.float32)
        preview = shrink(small, encoding.preview_shrink).astype(np.float32)
        images[name] = jpeg_uri(to_display(preview, gallery.exposure), encoding.quality)
        data = base64.b64encode(pack(coding.encode(small))).decode()
        packed[name] = {"rows": small.shape[0], "columns": small.shape[1], "data": data}
    for name, (colors, values) in gallery.maps.items():
        images[name] = map_uri(shrink(values, encoding.shrink), colors, encoding.shades)
    return coding, images, packed
