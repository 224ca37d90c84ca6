"""Curves of a periodic tile: uniform cubic B-splines with a radius.

Lengths are in tile widths, so the period is (1, aspect). A closed curve continues at its own start, shifted
by whole periods: a weft yarn by one period along x, a ring by none. An open curve ends at both ends.

A uniform cubic B-spline does not pass through its control points. Those of the closed spline that passes
through given points solve ``(c[i-1] + 4 c[i] + c[i+1]) / 6 = p[i]``, a cyclic system, once the shift's share
of each point is taken off: straight lines are reproduced exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

# Least number of points of a curve: fewer have no cubic spline.
LEAST_POINTS = 4


@dataclass(frozen=True)
class Curve:
    """A uniform cubic B-spline.

    Attributes
    ----------
    control : (n, 4) float64 array
        Control points x, y, z and their radii, in tile widths.
    shift : (3,) float64 array or None
        From the start to the end of a closed curve of n segments; multiples of the period, z is 0. None for
        an open curve, which has n - 3 segments.
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
        v = np.asarray(t - segment)
        w = 1.0 - v
        basis = np.stack([w**3, (3 * v - 6) * v * v + 4, ((3 - 3 * v) * v + 3) * v + 1, v**3], axis=-1) / 6
        slope = np.stack([-w * w, (3 * v - 4) * v, (2 - 3 * v) * v + 1, v * v], axis=-1) / 2
        return (
            np.einsum("mk,mkc->mc", basis, windows[segment]),
            np.einsum("mk,mkc->mc", slope, windows[segment]),
        )

    def heights(self) -> tuple[float, float]:
        """Lowest and highest z of the tube, at eight points per segment: within 2 % of a radius for curves
        that bend no more than their radius per segment."""
        p, _ = self.at(np.arange(0, 8 * len(self.windows()) + 1) / 8.0)
        return float((p[:, 2] - p[:, 3]).min()), float((p[:, 2] + p[:, 3]).max())


def interpolating(points: F64, shift: F64) -> F64:
    """Control points (n, k) of the closed spline through points (n, k), continued at ``points + shift``."""
    n = len(points)
    line = np.arange(n)[:, None] / n * shift
    # The system is circulant: a division in the frequency domain.
    weight = (4.0 + 2.0 * np.cos(2.0 * np.pi * np.arange(n // 2 + 1) / n)) / 6.0
    series = np.fft.rfft(points - line, axis=0) / weight[:, None]
    return np.asarray(np.fft.irfft(series, n, axis=0) + line)


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


def copies(curve: Curve, period: tuple[float, float]) -> Iterator[F64]:
    """Runs of control points (m, 4) of all segments that reach into the box [0, 1] x [0, aspect] of one
    period, moved there by whole periods."""
    points, windows = curve.unrolled(), curve.windows()
    # A segment lies within the hull of its four control points.
    reach = windows[:, :, 3].max(axis=1)[:, None]
    least, most = windows[:, :, :2].min(axis=1) - reach, windows[:, :, :2].max(axis=1) + reach
    size = np.asarray(period)
    # Segments [least, most] + k · period that meet [0, period].
    first, last = np.ceil(-most / size).astype(int), np.floor((size - least) / size).astype(int)
    for i in range(first[:, 0].min(), last[:, 0].max() + 1):
        for j in range(first[:, 1].min(), last[:, 1].max() + 1):
            k = np.array([i, j])
            inside = ((first <= k) & (k <= last)).all(axis=1)
            edges = np.flatnonzero(np.diff(np.r_[False, inside, False].astype(int)))
            for start, stop in zip(edges[::2], edges[1::2], strict=True):
                run = points[start : stop + 3].copy()
                run[:, :2] += k * size
                yield run
