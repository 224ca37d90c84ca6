"""Pictures as ``data:`` URIs, within a budget of bytes, and difference pictures with a stated scale."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

# Colours of a signed difference from -1 to 1, sRGB: blue is too dark, orange too bright, near black is
# right. Blue and orange stay apart under every common colour-vision deficiency; lightness alone gives size.
_STOPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_COLOURS = ((199, 233, 255), (34, 136, 209), (13, 15, 20), (214, 98, 16), (255, 232, 189))


def signed_colours(x: NDArray[np.floating]) -> U8:
    """sRGB (..., 3) of numbers (...) in [-1, 1]; numbers beyond are shown as the ends."""
    t = np.clip(np.nan_to_num(np.asarray(x, np.float64)), -1.0, 1.0)
    channels = [np.interp(t, _STOPS, [c[i] for c in _COLOURS]) for i in range(3)]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)


def difference_picture(fit: F32, reference: F32, scale: float) -> U8:
    """Mean over channels of fit minus reference (rows, columns, 3), as colours; ±`scale` are the ends."""
    return signed_colours((fit.astype(np.float64) - reference).mean(axis=-1) / scale)


def round_scale(x: float) -> float:
    """The next of 1, 2, 5 times a power of ten that is not below x; 1 where x is not positive."""
    if not x > 0 or not math.isfinite(x):
        return 1.0
    power = 10.0 ** math.floor(math.log10(x))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= x * (1 - 1e-9))


def difference_scale(pairs: Sequence[tuple[F32, F32]], white: float) -> float:
    """Scale for difference pictures of (fit, reference) pairs, as a rounded share of `white`.

    The 99th percentile of the absolute difference over all of them, so that the scale is one for all.
    """
    if not pairs:
        return 1.0
    sizes = np.concatenate([np.abs((f.astype(np.float64) - r).mean(axis=-1)).ravel() for f, r in pairs])
    return round_scale(float(np.percentile(sizes, 99)) / white)


@dataclass(frozen=True)
class Encoding:
    """How pictures are stored in the report.

    Attributes
    ----------
    quality : of JPEG without subsampling; None for lossless PNG
    shrink : this many pixels along each side become one
    """

    quality: int | None
    shrink: int = 1

    @property
    def name(self) -> str:
        """In words."""
        kind = "PNG, lossless" if self.quality is None else f"JPEG, quality {self.quality}"
        return kind if self.shrink == 1 else f"{kind}, every {self.shrink} × {self.shrink} pixels averaged"

    def encode(self, pixels: U8) -> tuple[str, bytes]:
        """(media type, bytes)."""
        from PIL import Image

        image = Image.fromarray(pixels)
        if self.shrink > 1:
            image = image.reduce(self.shrink)
        stream = io.BytesIO()
        if self.quality is None:
            image.save(stream, "PNG", optimize=True)
            return "image/png", stream.getvalue()
        image.save(stream, "JPEG", quality=self.quality, subsampling=0, optimize=True)
        return "image/jpeg", stream.getvalue()


# From the best to the smallest.
ENCODINGS = (Encoding(None), Encoding(95), Encoding(88), Encoding(75), *(Encoding(75, s) for s in (2, 4, 8)))


def data_uri(media: str, content: bytes) -> str:
    """``data:`` URI of a file's content."""
    return f"data:{media};base64,{base64.b64encode(content).decode()}"


def embed(pictures: Mapping[str, Callable[[], U8]], budget: float) -> tuple[dict[str, str], Encoding]:
    """``data:`` URIs of all pictures with the best encoding that fits.

    Parameters
    ----------
    pictures : name → function that makes its pixels (rows, columns, 3)
    budget : bytes that all URIs may take together; with the smallest encoding they may take more
    """
    for encoding in ENCODINGS:
        out: dict[str, str] = {}
        total = 0
        last = encoding is ENCODINGS[-1]
        for name, pixels in pictures.items():
            out[name] = data_uri(*encoding.encode(pixels()))
            total += len(out[name])
            if total > budget and not last:
                break
        if total <= budget or last:
            return out, encoding
    raise AssertionError("the last encoding is always taken")
