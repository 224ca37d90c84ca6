"""Linear images for the page: logarithmic codes, compressed losslessly, which it displays at any exposure.

A value v in 1/sr is stored as code 0 if it lies below the scale, otherwise as the nearest of ``low ·
2^((code-1) · step)`` with codes up to ``2^bits - 1``. All values have the same relative error. The page
computes one table from code to brightness per exposure.

Compression: codes are transformed to (g, r-g, b-g). Each channel is predicted by the mean, rounded down, of
the left and upper neighbors (0 beyond the border). Residuals are mapped to non-negative numbers (0, -1, 1,
-2 → 0, 1, 2, 3) and split into planes of low and high bytes, which are deflated (zlib format).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]

# Range of the exposure control: this many stops in both directions.
EXPOSURE_STOPS = 6.0
# Range of the codes below white in stops; its end is nearly black even at the highest exposure.
STOPS_BELOW = 16.0


@dataclass(frozen=True)
class Coding:
    """A logarithmic scale.

    Attributes
    ----------
    bits : per code
    low, high : values in 1/sr of the lowest and the highest code
    """

    bits: int
    low: float
    high: float

    @classmethod
    def spanning(cls, pictures: Iterable[F32], white: float, bits: int) -> Coding:
        """The scale from the smallest positive value, but at most 16 stops below `white`, to the largest."""
        values = [np.ravel(np.nan_to_num(p, posinf=0.0)) for p in pictures]
        highest = max((float(v.max(initial=0)) for v in values), default=0.0)
        lowest = min((float(v[v > 0].min(initial=white)) for v in values), default=white)
        return cls(bits, max(min(lowest, white / 2), white * 2.0**-STOPS_BELOW), max(white, highest))

    @property
    def largest(self) -> int:
        """The highest code."""
        return (1 << self.bits) - 1

    @property
    def step(self) -> float:
        """Stops between neighboring codes."""
        return math.log2(self.high / self.low) / (self.largest - 1)

    @property
    def relative_error(self) -> float:
        """Largest relative error of a value within the scale."""
        return 2.0 ** (self.step / 2) - 1.0

    def encode(self, picture: F32) -> I32:
        """Codes of linear values, same shape."""
        value = np.nan_to_num(np.asarray(picture, np.float64), posinf=self.high)
        with np.errstate(divide="ignore"):
            stops = np.log2(np.maximum(value, 0.0) / self.low)
        codes = np.clip(np.round(stops / self.step) + 1.0, 0, self.largest)
        return codes.astype(np.int32)

    def decode(self, codes: I32) -> F32:
        """Linear values of codes."""
        value = self.low * 2.0 ** ((codes - 1) * self.step)
        return np.where(codes > 0, value, 0.0).astype(np.float32)

    def describe(self) -> dict[str, Any]:
        """Parameters for decoding on the page."""
        return {"bits": self.bits, "low": self.low, "step": self.step}


def pack(codes: I32) -> bytes:
    """Compress codes (rows, columns, 3) of at most 15 bits."""
    r, g, b = (codes[..., i].astype(np.int32) for i in range(3))
    planes = []
    for channel in (g, r - g, b - g):
        left, up = np.zeros_like(channel), np.zeros_like(channel)
        left[:, 1:], up[1:] = channel[:, :-1], channel[:-1]
        rest = channel - ((left + up) >> 1)
        folded = np.where(rest >= 0, 2 * rest, -2 * rest - 1).astype(np.uint32)
        planes += [(folded & 255).astype(np.uint8), (folded >> 8).astype(np.uint8)]
    return zlib.compress(b"".join(p.tobytes() for p in planes), 9)
