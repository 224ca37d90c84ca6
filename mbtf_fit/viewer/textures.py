"""Textures of a page: 6 to 16 bits per number, predicted from their neighbors and compressed.

Each level and channel has its own range. A number is stored as the difference from the median edge detector's
prediction by the texels to its left, above, and above left (LOCO-I: Weinberger, Seroussi and Sapiro, IEEE
Transactions on Image Processing 9(8), 2000), modulo 2^bits; where neighboring channels are alike, the
difference from the channel before takes the place of the number. All of a texture form one zlib stream: first
the low bytes, then the high bytes where there are more than 8 bits. ``page/data.js`` reads it.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class PackedTexture:
    """A texture with all its levels.

    Attributes
    ----------
    description : ``shapes`` (rows, columns) of each level, coarsest first; ``channels``; ``bits``; ``alike``;
        ``low`` and ``step`` by level and channel; ``data``, the stream in base64
    levels : (rows, columns, channels) arrays that a reader gets
    """

    description: dict[str, Any]
    levels: tuple[F32, ...]


def predicted(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Predictions (rows, columns) of whole numbers by their neighbors; 0 of the first."""
    out = np.zeros_like(values)
    left, above, corner = values[1:, :-1], values[:-1, 1:], values[:-1, :-1]
    low, high = np.minimum(left, above), np.maximum(left, above)
    out[1:, 1:] = np.where(corner >= high, low, np.where(corner <= low, high, left + above - corner))
    out[0, 1:] = values[0, :-1]
    out[1:, 0] = values[:-1, 0]
    return out


def pack(levels: Sequence[F32], bits: int = 8, *, alike: bool = False) -> PackedTexture:
    """Quantize and compress a texture.

    Parameters
    ----------
    levels : (rows, columns, channels) arrays, coarsest first
    bits : per number, up to 16
    alike : whether neighboring channels are alike

    Raises
    ------
    InputError : a number is not finite
    """
    largest = (1 << bits) - 1
    lows: list[list[float]] = []
    steps: list[list[float]] = []
    read, stored = [], []
    for texels in levels:
        if not np.isfinite(texels).all():
            raise InputError("a texture of the material holds numbers that are not finite")
        low = texels.min((0, 1)).astype(np.float64)
        step = (texels.max((0, 1)) - low) / largest
        whole = np.rint((texels - low) / np.where(step > 0, step, 1.0)).astype(np.int64)
        lows.append([float(np.float32(x)) for x in low])
        steps.append([float(np.float32(x)) for x in step])
        read.append(
            (np.array(lows[-1], np.float32) + whole * np.array(steps[-1], np.float32)).astype(np.float32)
        )
        planes = np.moveaxis(whole, 2, 0)
        if alike:
            planes = np.diff(planes, axis=0, prepend=0)
        stored += [((plane - predicted(plane)) & largest).reshape(-1) for plane in planes]
    numbers = np.concatenate(stored)
    parts = [numbers & 255, *([numbers >> 8] if bits > 8 else [])]
    # The strategy for data whose small numbers are frequent.
    coder = zlib.compressobj(9, strategy=zlib.Z_FILTERED)
    stream = coder.compress(b"".join(part.astype(np.uint8).tobytes() for part in parts)) + coder.flush()
    description = {
        "shapes": [list(texels.shape[:2]) for texels in levels],
        "channels": int(levels[0].shape[2]),
        "bits": bits,
        "alike": alike,
        "low": lows,
        "step": steps,
        "data": base64.b64encode(stream).decode(),
    }
    return PackedTexture(description, tuple(read))
