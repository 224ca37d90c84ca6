"""Images as ``data:`` URIs and compressed linear data, within a size limit."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mbtf_pipeline.report.error_maps import Palette, indices, palette
from mbtf_pipeline.report.linear_images import Coding, pack

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Pixels = NDArray[np.floating]
Linear = Callable[[], F32]


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


def data_uri(media: str, content: bytes) -> str:
    """``data:`` URI of a file's content."""
    return f"data:{media};base64,{base64.b64encode(content).decode()}"


def jpeg_uri(display: U8, quality: int) -> str:
    """``data:`` URI of an 8-bit sRGB image as JPEG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(display).save(stream, "JPEG", quality=quality, subsampling=0, optimize=True)
    return data_uri("image/jpeg", stream.getvalue())


def map_uri(values: Pixels, name: Palette, shades: int) -> str:
    """``data:`` URI of a map (rows, columns) as PNG with `shades` colors of a palette."""
    from PIL import Image

    steps = np.round(indices(values, name) * ((shades - 1) / 255.0))
    image = Image.fromarray(np.round(steps * (255.0 / (shades - 1))).astype(np.uint8))
    image.putpalette([channel for color in palette(name) for channel in color])
    stream = io.BytesIO()
    image.save(stream, "PNG", optimize=True)
    return data_uri("image/png", stream.getvalue())


@dataclass
class Gallery:
    """Images of the page by name.

    Attributes
    ----------
    white : linear value displayed as white, 1/sr
    linear : functions that read images (rows, columns, 3) in 1/sr
    maps : palettes and maps (rows, columns), scaled to [0, 1] or, if signed, to [-1, 1]
    """

    white: float
    linear: dict[str, Linear] = field(default_factory=dict)
    maps: dict[str, tuple[Palette, Pixels]] = field(default_factory=dict)

    def add_map(self, name: str, palette: Palette, values: Pixels) -> None:
        """Add a scaled map."""
        self.maps[name] = (palette, values)


@dataclass(frozen=True)
class Embedded:
    """Encoded images.

    Attributes
    ----------
    images : ``data:`` URIs of maps, and of linear images at 0 EV, by name
    packed : rows, columns and data of linear images by name
    """

    encoding: Encoding
    coding: Coding
    images: dict[str, str]
    packed: dict[str, Mapping[str, int | str]]

    @property
    def size(self) -> int:
        """Total size in bytes."""
        return sum(map(len, self.images.values())) + sum(len(str(p["data"])) for p in self.packed.values())


def embed(gallery: Gallery, budget: float) -> Embedded:
    """Encode a gallery with the best encoding within `budget` bytes, or else with the smallest."""
    for encoding in ENCODINGS:
        out = encode(gallery, encoding)
        if out.size <= budget:
            break
    return out


def encode(gallery: Gallery, encoding: Encoding) -> Embedded:
    """Encode a gallery with a given encoding."""
    from mbtf_gen.pictures.reference import to_display

    pictures = {name: read() for name, read in gallery.linear.items()}
    coding = Coding.spanning(pictures.values(), gallery.white, encoding.bits)
    images: dict[str, str] = {}
    packed: dict[str, Mapping[str, int | str]] = {}
    for name, picture in pictures.items():
        small = shrink(picture, encoding.shrink).astype(np.float32)
        preview_shrink = to_display(
            shrink(small, encoding.preview_shrink).astype(np.float32), 1.0 / gallery.white
        )
        images[name] = jpeg_uri(preview_shrink, encoding.quality)
        data = base64.b64encode(pack(coding.encode(small))).decode()
        packed[name] = {"rows": small.shape[0], "columns": small.shape[1], "data": data}
    for name, (colors, values) in gallery.maps.items():
        images[name] = map_uri(shrink(values, encoding.shrink), colors, encoding.shades)
    return Embedded(encoding, coding, images, packed)
