"""Directions of angular slices: the fixed lights and views at which every texel is sampled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.schema import SliceDirections
from mbtf_gen.sampling.exact_math import sincos_turns

F32 = NDArray[np.float32]
# (angle to the normal in degrees, directions on that circle) of the BTF database Bonn 2003: Sattler, Sarlette
# and Klein, "Efficient and realistic visualization of cloth", EGSR 2003. The first of each circle has the
# azimuth 0.
_UBO2003 = ((0, 1), (15, 6), (30, 12), (45, 18), (60, 20), (75, 24))
UBO2003_COUNT = sum(count for _, count in _UBO2003)
UBO2003_LOWEST = math.cos(math.radians(_UBO2003[-1][0]))
# Turns between neighbors of the spiral: one minus the inverse of the golden ratio.
_GOLDEN = (3.0 - math.sqrt(5.0)) / 2.0


def slice_directions(kind: SliceDirections, count: int, min_cos: float) -> F32:
    """Directions (n, 3) of a slice, n = `count` for the spiral and 81 for ``ubo2003``.

    The spiral covers the projected disk down to the cosine `min_cos` with equal density (Vogel 1979).
    """
    if kind == "ubo2003":
        angle = np.repeat([a for a, _ in _UBO2003], [n for _, n in _UBO2003]) / 360.0
        turns = np.concatenate([np.arange(n) / n for _, n in _UBO2003])
        sine, z = sincos_turns(angle)
    else:
        sine2 = (np.arange(count) + 0.5) / count * ((1.0 - min_cos) * (1.0 + min_cos))
        sine, z = np.sqrt(sine2), np.sqrt(1.0 - sine2)
        turns = np.arange(count) * _GOLDEN % 1.0
    s, c = sincos_turns(turns)
    return np.stack([sine * c, sine * s, z], axis=-1).astype(np.float32)


def direction_pairs(directions: F32) -> tuple[F32, F32]:
    """Lights and views (n², 3) of a slice: every view under the first light, then under the next."""
    count = len(directions)
    return np.repeat(directions, count, axis=0), np.tile(directions, (count, 1))
