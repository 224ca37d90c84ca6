"""Curves of a periodic tile, and files of them: uniform cubic B-splines with a radius.

Lengths are in tile widths, so the period is (1, aspect). A closed curve continues at its own start, shifted
by whole periods: a weft yarn by one period along x, a ring by none. An open curve ends at both ends.

A uniform cubic B-spline does not pass through its control points. Those of the closed spline that passes
through given points solve ``(c[i-1] + 4 c[i] + c[i+1]) / 6 = p[i]``, a cyclic system, once the shift's share
of each point is taken off: straight lines are reproduced exactly.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason

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


log = logging.getLogger(__name__)

_HEADER = struct.Struct("<3sBccBBQQ40s")
_COMPLETE = "check that the file is complete"
# Most control points of a tile: they take 1.5 GB while they are read.
MOST_POINTS = 4_000_000


def read_curves(path: Path) -> list[Curve]:
    """Curves of a file, in its units. Those of a ``.bcc`` have the radius 0: the file has none.

    Raises
    ------
    InputError : unreadable, truncated, or numbers that are no curves
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    curves = _bcc(data, path) if path.suffix.lower() == ".bcc" else _text(data, path)
    if not curves:
        raise InputError("has no curves", where=path)
    return curves


def _bcc(data: bytes, path: Path) -> list[Curve]:
    if len(data) < _HEADER.size:
        raise InputError("is too short for a .bcc file", where=path, hint=_COMPLETE)
    magic, sizes, kind, spline, dimensions, up, curves, points, _ = _HEADER.unpack_from(data)
    if magic != b"BCC":
        raise InputError("is not a .bcc file", where=path)
    if (sizes, kind, spline, dimensions) != (0x44, b"C", b"0", 3) or up > 2:
        raise InputError("holds curves that are not uniform Catmull-Rom curves in 3D", where=path)
    if len(data) != _HEADER.size + 4 * curves + 12 * points:
        raise InputError(
            f"has {len(data)} bytes, not those of {curves} curves with {points} points",
            where=path,
            hint=_COMPLETE,
        )
    if points > MOST_POINTS:
        raise InputError(f"has {points:,} points, more than {MOST_POINTS:,}", where=path)
    out, at = [], _HEADER.size
    deviation = 0.0
    for number in range(curves):
        if at + 4 > len(data):
            raise InputError(f"ends in curve {number}", where=path, hint=_COMPLETE)
        (count,) = struct.unpack_from("<i", data, at)
        at += 4
        if at + 12 * abs(count) > len(data):
            raise InputError(f"ends in curve {number}", where=path, hint=_COMPLETE)
        xyz = np.frombuffer(data, "<f4", 3 * abs(count), at).reshape(-1, 3).astype(np.float64)
        at += 12 * abs(count)
        # The dimension that points up becomes the last one; the others keep their order around it.
        xyz = np.roll(xyz, 2 - up, axis=1)
        _check(xyz, number, path)
        out.append(_through(xyz, count < 0))
        deviation = max(deviation, _deviation(out[-1], xyz))
    log.info(
        f"{path.name}: splines deviate from its Catmull-Rom curves by at most {deviation:.2g} of its units"
    )
    return out


def _deviation(curve: Curve, points: F64) -> float:
    """Largest distance from the Catmull-Rom curve halfway between its points, where it is largest."""
    closed = curve.shift is not None
    around = np.concatenate([points[-1:], points, points[:2]]) if closed else points
    halfway = (9.0 * (around[1:-2] + around[2:-1]) - around[:-3] - around[3:]) / 16.0
    at = np.arange(len(halfway), dtype=np.float64) + (0.5 if closed else 1.5)
    return float(np.linalg.norm(curve.at(at)[0][:, :3] - halfway, axis=1).max(initial=0.0))


def _through(points: F64, closed: bool) -> Curve:
    """The B-spline through points, of which Catmull-Rom is an approximation of the same order."""
    radius = np.zeros(len(points))
    if closed:
        return Curve(np.column_stack([interpolating(points, np.zeros(3)), radius]), np.zeros(3))
    from scipy.linalg import solve_banded

    # Straight ends: the second derivative is zero at the first and at the last point.
    n = len(points)
    bands = np.array([[1 / 6] * n, [4 / 6] * n, [1 / 6] * n])
    bands[1, [0, -1]], bands[0, 1], bands[2, -2] = 1.0, 0.0, 0.0
    control = solve_banded((1, 1), bands, points)
    ends = 2.0 * control[[0, -1]] - control[[1, -2]]
    control = np.concatenate([ends[:1], control, ends[1:]])
    return Curve(np.column_stack([control, np.zeros(n + 2)]))


def _text(data: bytes, path: Path) -> list[Curve]:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"is not text (byte {error.start})", where=path) from None
    if len(lines) > MOST_POINTS:
        raise InputError(f"has {len(lines):,} lines, more than {MOST_POINTS:,}", where=path)
    runs: list[list[list[float]]] = [[]]
    for number, line in enumerate(lines, 1):
        if not line.strip():
            if runs[-1]:
                runs.append([])
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError as error:
            raise InputError(f"line {number}: {reason(error)}", where=path) from None
        if len(row) != 4:
            raise InputError(
                f"line {number} has {len(row)} numbers, not x, y, z and radius", where=path, hint=_COMPLETE
            )
        runs[-1].append(row)
    out = []
    for number, run in enumerate(run for run in runs if run):
        control = np.array(run)
        _check(control, number, path)
        if (control[:, 3] <= 0).any():
            raise InputError(f"curve {number} has a radius that is not positive", where=path)
        out.append(Curve(control))
    return out


def _check(points: F64, number: int, path: Path) -> None:
    if len(points) < LEAST_POINTS:
        raise InputError(f"curve {number} has {len(points)} points, fewer than {LEAST_POINTS}", where=path)
    if not np.isfinite(points).all() or np.abs(points).max(initial=0.0) > 1e15:
        raise InputError(f"curve {number} has points that are not finite numbers below 1e15", where=path)
