"""Files of curves: ``.bcc``, and the text of Mitsuba's ``bsplinecurve`` (``.curves``).

A ``.bcc`` (Yuksel, Kaldor, James and Marschner 2012, "Stitch meshes") has a header of 64 bytes: ``BCC``, the
sizes of integers and floats (0x44 for four bytes each), the type ``C0`` (uniform Catmull-Rom), the number of
dimensions, the dimension that points up, the numbers of curves and of points (two uint64), and text. Then
follow, for each curve, the number of its points as an int32, negative for a closed curve, and the points as
float32.

The text has one control point ``x y z radius`` per line, and an empty line between curves.
"""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np

from mbtf_core.errors import InputError, reason
from mbtf_gen.tile.fibers.curves import F64, LEAST_POINTS, Curve, interpolating

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
