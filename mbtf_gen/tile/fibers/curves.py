"""Curves of a periodic tile: uniform cubic B-splines with a radius.

Lengths are in tile widths, so the period is (1, aspect). A closed curve continues at its own start, shifted
by whole periods: a weft yarn by one period along x, a ring by none. An open curve ends at both ends.

A uniform cubic B-spline does not pass through its control points. Those of the closed spline that passes
through given points solve ``(c[i-1] + 4 c[i] + c[i+1]) / 6 = p[i]``, a cyclic system, once the shift's share
of each point is taken off: straight lines are reproduced exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

# Least number of points of a curve: fewer have no cubic spline.
LEAST_POINTS = 4
# Longest segment over its smallest radius. Embree misses rays near a tube's silhouette, the more the longer
# the segment is: 0.03% of the hits at 100 radii, 0.1% at 400, 5 to 40% at 10⁴.
LONGEST_SEGMENT = 100.0
# Smallest radius over the longest side of the box around a tile. The rounding of positions to float32 costs
# 0.1% of the hits there, 0.2% at half of it; scattered rays start a tenth of it from the surface.
THINNEST = 1e-5


@dataclass(frozen=True)
class Curve:
    """A uniform cubic B-spline.

    Attributes
    ----------
    control : (n, 4), control points x, y, z and their radii, in tile widths
    shift : (3,), from the start to the end of a closed curve of n segments; multiples of the period, z is 0;
        none for an open curve, which has n - 3 segments
    """

    control: F64
    shift: F64 | None = None

    @classmethod
    def through(cls, points: F64, radius: float, shift: F64) -> Curve:
        """The closed curve of one radius through points (n, 3)."""
        control = interpolating(points, shift)
        return cls(np.column_stack([control, np.full(len(control), radius)]), shift)

    def moved(self, by: F64) -> Curve:
        """The curve, moved by a vector (3,)."""
        return replace(self, control=self.control + np.append(by, 0.0))

    def unrolled(self) -> F64:
        """Control points (segments + 3, 4) of all segments."""
        if self.shift is None:
            return self.control
        n = len(self.control)
        turns, wrapped = np.divmod(np.arange(-1, n + 2), n)
        return self.control[wrapped] + turns[:, None] * np.append(self.shift, 0.0)

    def windows(self) -> F64:
        """The four control points of each segment, (segments, 4, 4), the last axis x, y, z, radius."""
        return np.lib.stride_tricks.sliding_window_view(self.unrolled(), 4, axis=0).transpose(0, 2, 1)

    def at(self, t: F64) -> tuple[F64, F64]:
        """Positions and radii (m, 4), and their derivatives, at parameters t in segments from the start."""
        windows = self.windows()
        segment = np.clip(np.floor(t).astype(int), 0, len(windows) - 1)
        basis, slope = bases(np.asarray(t - segment))
        return (
            np.einsum("km,mkc->mc", basis, windows[segment]),
            np.einsum("km,mkc->mc", slope, windows[segment]),
        )

    def halved(self) -> Curve:
        """The same curve with two segments for each one (Lane and Riesenfeld 1980, "A theoretical development
        for the computer generation and display of piecewise polynomial surfaces")."""
        points = self.unrolled()
        fine = np.empty((2 * len(points) - 3, 4))
        fine[::2] = (points[:-1] + points[1:]) / 2.0
        fine[1::2] = (points[:-2] + 6.0 * points[1:-1] + points[2:]) / 8.0
        return replace(self, control=fine if self.shift is None else fine[1:-2])


class Bundle:
    """The segments of many curves in one array: loops over curves would take most of the time.

    Attributes
    ----------
    points : (n, 4), control points of all segments, curve by curve, see :meth:`Curve.unrolled`
    starts : (curves,), row of each curve's first control point
    owner : (segments,), curve of each segment
    first : (segments,), row of the first of the four control points of each segment
    """

    def __init__(self, curves: Sequence[Curve]) -> None:
        runs = [curve.unrolled() for curve in curves]
        lengths = np.array([len(run) for run in runs])
        self.points = np.concatenate(runs)
        self.starts = np.cumsum(lengths) - lengths
        self.owner = np.repeat(np.arange(len(runs)), lengths - 3)
        self.first = np.arange(len(self.owner)) + 3 * self.owner

    def at(self, v: float) -> tuple[F64, F64]:
        """Positions and radii (segments, 4), and their derivatives, at a parameter v in [0, 1] of each
        segment."""
        basis, slope = bases(v)
        return self._sum(basis, self.points), self._sum(slope, self.points)

    def _sum(self, weights: F64, values: F64) -> F64:
        """Sums over the control points of each segment of values (n, k), weighted."""
        rows = len(values) - 3
        out = weights[0] * values[:rows]
        for k in range(1, 4):
            out += weights[k] * values[k : rows + k]
        return np.asarray(out[self.first])

    def heights(self) -> tuple[float, float]:
        """Lowest and highest z of the tubes, at eight points per segment: within 2% of a radius for curves
        that bend no more than their radius per segment."""
        z, radius = self.points[:, 2], self.points[:, 3]
        sides = np.column_stack([z - radius, z + radius])
        values = [self._sum(bases(v)[0], sides) for v in np.arange(9) / 8.0]
        return float(min(v[:, 0].min() for v in values)), float(max(v[:, 1].max() for v in values))

    def halvings(self) -> NDArray[np.int_]:
        """How often each curve (curves,) is halved until no segment is longer than 100 radii."""
        # No segment is longer than the longest step between its control points.
        step = np.linalg.norm(np.diff(self.points[:, :3], axis=0), axis=1)
        radius = self.points[:, 3]
        longest = np.max([step[self.first + k] for k in range(3)], axis=0)
        least = np.min([radius[self.first + k] for k in range(4)], axis=0)
        # Each curve before has three rows more than segments.
        ratio = np.maximum.reduceat(longest / least, self.starts - 3 * np.arange(len(self.starts)))
        return np.ceil(np.log2(np.maximum(ratio / LONGEST_SEGMENT, 1.0))).astype(int)

    def copies(self, period: tuple[float, float]) -> tuple[list[F64], NDArray[np.int_]]:
        """Runs of control points (m, 4) of all segments that reach into the box [0, 1] x [0, aspect] of one
        period, moved there by whole periods, and the curve of each run."""
        # A segment lies within the hull of its four control points.
        around = [self.points[self.first + k] for k in range(4)]
        reach = np.max([p[:, 3] for p in around], axis=0)[:, None]
        least = np.min([p[:, :2] for p in around], axis=0) - reach
        most = np.max([p[:, :2] for p in around], axis=0) + reach
        size = np.asarray(period)
        # Segments [least, most] + k · period that meet [0, period].
        first, last = np.ceil(-most / size).astype(int), np.floor((size - least) / size).astype(int)
        found = []
        for i in range(first[:, 0].min(), last[:, 0].max() + 1):
            column = np.flatnonzero((first[:, 0] <= i) & (i <= last[:, 0]))
            if not len(column):
                continue
            for j in range(first[column, 1].min(), last[column, 1].max() + 1):
                inside = column[(first[column, 1] <= j) & (j <= last[column, 1])]
                # A run ends where the next segment is outside, or of another curve.
                ends = np.flatnonzero(np.diff(self.first[inside], append=-1) != 1)
                begins = np.r_[0, ends[:-1] + 1]
                found += [
                    (self.owner[a], i, j, self.first[a], self.first[b] + 4)
                    for a, b in zip(inside[begins], inside[ends], strict=True)
                ]
        found.sort()
        runs = []
        for _, i, j, start, stop in found:
            run = self.points[start:stop].copy()
            run[:, :2] += (i, j) * size
            runs.append(run)
        return runs, np.array([row[0] for row in found], int)


def bases(v: float | F64) -> tuple[F64, F64]:
    """Weights (4, ...) of the control points of a segment at v in [0, 1], and of its derivative."""
    w = 1.0 - v
    basis = np.stack([w**3, (3 * v - 6) * v * v + 4, ((3 - 3 * v) * v + 3) * v + 1, v**3]) / 6
    slope = np.stack([-w * w, (3 * v - 4) * v, (2 - 3 * v) * v + 1, v * v]) / 2
    return basis, slope


def interpolating(points: F64, shift: F64) -> F64:
    """Control points (..., n, k) of closed splines through points (..., n, k), each continued at
    ``points + shift``."""
    n = points.shape[-2]
    line = np.arange(n)[:, None] / n * shift
    # The system is circulant: a division in the frequency domain.
    weight = (4.0 + 2.0 * np.cos(2.0 * np.pi * np.arange(n // 2 + 1) / n)) / 6.0
    series = np.fft.rfft(points - line, axis=-2) / weight[:, None]
    return np.asarray(np.fft.irfft(series, n, axis=-2) + line)


def level_frames(tangents: F64) -> tuple[F64, F64]:
    """(side, up) of unit tangents (n, 3) that are nowhere vertical: the side is horizontal, up is at right
    angles to both."""
    side = np.cross([0.0, 0.0, 1.0], tangents)
    side /= np.linalg.norm(side, axis=1)[:, None]
    return side, np.cross(tangents, side)


def closed_frames(tangents: F64) -> tuple[F64, F64]:
    """Normals and binormals (n, 3) along a closed curve of unit tangents (n, 3), whose last is followed by
    the first. They turn as little as possible, and by the same angle everywhere, so that they close."""
    n = len(tangents)
    normal = np.empty((n + 1, 3))
    first = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    normal[0] = first / np.linalg.norm(first)
    for i in range(n):
        # The shortest rotation from one tangent to the next (Bishop 1975, "There is more than one way to
        # frame a curve").
        a, b = tangents[i], tangents[(i + 1) % n]
        moved = normal[i] - (normal[i] @ b) / (1.0 + a @ b) * (a + b)
        moved -= (moved @ b) * b
        normal[i + 1] = moved / np.linalg.norm(moved)
    binormal = np.cross(tangents, normal[:-1])
    # The last normal is at right angles to the first tangent, as the first one is.
    gap = np.arctan2(normal[-1] @ binormal[0], normal[-1] @ normal[0])
    angle = -gap * np.arange(n) / n
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return c * normal[:-1] + s * binormal, c * binormal - s * normal[:-1]
