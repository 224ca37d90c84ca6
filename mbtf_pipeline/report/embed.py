"""Pictures as ``data:`` URIs and packed linear data, within a budget of bytes."""

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
Field = NDArray[np.floating]
Linear = Callable[[], F32]


def shrink(values: Field, factor: int) -> Field:
    """Average `factor` × `factor` pixels of (rows, columns, ...); rows and columns left over are cut off."""
    if factor == 1:
        return values
    factor = min(factor, *values.shape[:2])
    rows, columns = (n // factor for n in values.shape[:2])
    cut = values[: rows * factor, : columns * factor]
    out: Field = cut.reshape(rows, factor, columns, factor, *values.shape[2:]).mean(axis=(1, 3))
    return out


@dataclass(frozen=True)
class Encoding:
    """How pictures are stored in the report.

    Attributes
    ----------
    bits : of a channel's logarithmic code
    quality : of JPEG for the fixed pictures, without subsampling
    shrink : this many pixels along each side become one
    still : the same, for the fixed pictures only, on top of it
    shades : colors of a map
    """

    bits: int
    quality: int
    shrink: int = 1
    still: int = 1
    shades: int = 256

    def describe(self, coding: Coding) -> str:
        """In words."""
        data = f"{self.bits} bits per channel on a logarithmic scale, within {coding.relative_error:.1%}"
        less = [f"{self.shrink} × {self.shrink} pixels averaged"] if self.shrink > 1 else []
        less += [f"maps in {self.shades} shades"] if self.shades < 256 else []
        return f"{data}; to keep the file small: {', '.join(less)}" if less else data


# From the best to the smallest.
ENCODINGS = (
    Encoding(10, 88),
    Encoding(9, 82),
    Encoding(9, 80, still=2, shades=64),
    *(Encoding(8, 75, shrink, still=2, shades=32) for shrink in (1, 2, 4, 8, 16)),
)


def data_uri(media: str, content: bytes) -> str:
    """``data:`` URI of a file's content."""
    return f"data:{media};base64,{base64.b64encode(content).decode()}"


def photograph(display: U8, quality: int) -> str:
    """``data:`` URI of an 8-bit sRGB picture as JPEG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(display).save(stream, "JPEG", quality=quality, subsampling=0, optimize=True)
    return data_uri("image/jpeg", stream.getvalue())


def chart(field: Field, name: Palette, shades: int) -> str:
    """``data:`` URI of a map (rows, columns) as PNG, in so many of a palette's 256 colors."""
    from PIL import Image

    steps = np.round(indices(field, name) * ((shades - 1) / 255.0))
    image = Image.fromarray(np.round(steps * (255.0 / (shades - 1))).astype(np.uint8))
    image.putpalette([channel for color in palette(name) for channel in color])
    stream = io.BytesIO()
    image.save(stream, "PNG", optimize=True)
    return data_uri("image/png", stream.getvalue())


@dataclass
class Gallery:
    """What the page shows, by name; read when it is encoded.

    Attributes
    ----------
    white : linear value shown as white, 1/sr
    linear : pictures (rows, columns, 3) in 1/sr
    charts : maps (rows, columns) with their palettes, sizes from 0 to 1 or signed from -1 to 1
    """

    white: float
    linear: dict[str, Linear] = field(default_factory=dict)
    charts: dict[str, tuple[Palette, Callable[[], Field]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Embedded:
    """Everything encoded.

    Attributes
    ----------
    images : name → ``data:`` URI, of linear pictures at 0 EV
    packed : name of a linear picture → {rows, columns, data}
    """

    encoding: Encoding
    coding: Coding
    images: dict[str, str]
    packed: dict[str, Mapping[str, int | str]]

    @property
    def size(self) -> int:
        """Bytes of all that is embedded."""
        return sum(map(len, self.images.values())) + sum(len(str(p["data"])) for p in self.packed.values())


def embed(gallery: Gallery, budget: float) -> Embedded:
    """Encode a gallery with the best encoding that fits.

    Parameters
    ----------
    budget : bytes that all may take together; with the smallest encoding they may take more
    """
    for encoding in ENCODINGS:
        out = encode(gallery, encoding)
        if out.size <= budget:
            break
    return out


def encode(gallery: Gallery, encoding: Encoding) -> Embedded:
    """Encode a gallery in one way."""
    from mbtf_gen.pictures.reference import to_display

    pictures = {name: read() for name, read in gallery.linear.items()}
    coding = Coding.spanning(pictures.values(), gallery.white, encoding.bits)
    images: dict[str, str] = {}
    packed: dict[str, Mapping[str, int | str]] = {}
    for name, picture in pictures.items():
        small = shrink(picture, encoding.shrink).astype(np.float32)
        still = to_display(shrink(small, encoding.still).astype(np.float32), 1.0 / gallery.white)
        images[name] = photograph(still, encoding.quality)
        data = base64.b64encode(pack(coding.encode(small))).decode()
        packed[name] = {"rows": small.shape[0], "columns": small.shape[1], "data": data}
    for name, (colors, read) in gallery.charts.items():
        images[name] = chart(shrink(read(), encoding.shrink), colors, encoding.shades)
    return Embedded(encoding, coding, images, packed)
