"""Effective resolution of a height map's integer codes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Fraction of texels at either end of the histogram that is ignored, because rare codes leave gaps.
_TAIL = 0.005
# Fewer levels are treated as an intentionally terraced or binary surface.
_FEWEST = 16
# Codes of a stretched histogram lie this close to a straight line over their rank: rounding, and a little.
_STRAIGHT = 0.75


@dataclass(frozen=True)
class Codes:
    """Distribution of the integer codes of a height map.

    Attributes
    ----------
    levels : number of different codes
    low, high : smallest and largest code
    spacing : distance of neighboring levels in codes; 1 unless the histogram was stretched
    """

    levels: int
    low: int
    high: int
    spacing: float

    @property
    def rounding(self) -> float:
        """Step, in codes, of the rounding that the heights went through.

        A histogram stretched by a factor f was rounded twice, to f codes and to one, so the variance is
        (f² + 1)/12, that of a step √(f² + 1); a whole f needs no second rounding.
        """
        whole = abs(self.spacing - round(self.spacing)) < 1e-6
        return self.spacing if whole else math.hypot(self.spacing, 1.0)


def code_use(codes: NDArray[Any]) -> Codes:
    """Levels and spacing of integer codes (H, W).

    The spacing is the slope of the least-squares line through the used codes over their rank, between the
    0.5th and the 99.5th percentile of the texels, if all of these codes lie within 0.75 of the line; else 1.
    """
    used, counts = np.unique(np.asarray(codes, np.int64), return_counts=True)
    levels, low, high = len(used), int(used[0]), int(used[-1])
    below = np.cumsum(counts) / counts.sum()
    inner = used[(below > _TAIL) & (below - counts / counts.sum() < 1.0 - _TAIL)]
    spacing = 1.0
    if levels >= _FEWEST and len(inner) >= _FEWEST:
        rank = np.arange(len(inner), dtype=np.float64)
        slope, offset = np.polyfit(rank, inner.astype(np.float64), 1)
        if np.abs(inner - offset - slope * rank).max() <= _STRAIGHT:
            spacing = float(round(slope) if abs(slope - round(slope)) < 1e-3 else slope)
    return Codes(levels, low, high, max(1.0, spacing))
