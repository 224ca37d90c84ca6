"""Files of fibers: Yuksel's binary curve collections (``.bcc``), and the text of Mitsuba's ``bsplinecurve``.

The curves of a ``.bcc`` pass through its points: Catmull-Rom curves or polylines. They become the cubic
splines through the same points.
"""

from __future__ import annotations

import codecs
import itertools
import logging
import os
import struct
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, reason
from mbtf_core.paths import opened
from mbtf_gen.tile.fibers.curves import F64, LEAST_POINTS, Curve, bases, interpolating

log = logging.getLogger(__name__)

_HEADER = struct.Struct("<3sBccBBQQ40s")
_COMPLETE = "check that the file is complete"
# Bytes of a number, by the header's code: integers and floats of 4 bytes, or of 8.
_SIZES = {0x44: 4, 0x88: 8}
_KINDS = {b"C0": "Catmull-Rom curves", b"PL": "polylines"}
_OTHERS = {b"C1": "chordal Catmull-Rom curves", b"C5": "centripetal Catmull-Rom curves"}
# Most control points of a file, and curves: they take 1.9 GB while they are read.
MOST_POINTS = 4_000_000
MOST_CURVES = 250_000
# Bytes of a line of text; a longer one has more than four numbers.
_LONGEST_LINE = 1 << 12
# Largest coordinate; squares of larger ones are beyond float32.
_MOST = 1e15


def lines(stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Lines and their numbers, from 1, without a byte order mark. Those that are too long come in pieces."""
    for number, line in enumerate(iter(lambda: stream.readline(_LONGEST_LINE), b""), 1):
        yield number, line.removeprefix(codecs.BOM_UTF8) if number == 1 else line


def numbers(words: Sequence[bytes]) -> list[float]:
    """Numbers of words; none where a word is no number."""
    try:
        # Python takes 1_000 for a thousand.
        return [float(word.replace(b"_", b"?")) for word in words]
    except ValueError:
        return []


def read_curves(path: Path) -> tuple[list[Curve], float]:
    """Curves of a file, in its units.

    Parameters
    ----------
    path : a ``.bcc``, else text: control points and radii of uniform cubic B-splines

    Returns
    -------
    list of Curve
        Those of a ``.bcc`` have the radius 0: the file has none.
    float
        Largest distance of the splines from the curves of the file.

    Raises
    ------
    InputError : the file is unreadable or truncated, of another kind, or its numbers are no curves
    """
    with opened(path) as stream:
        if path.suffix.lower() == ".bcc":
            curves, deviation = _bcc(stream, path)
        else:
            curves, deviation = _text(stream, path), 0.0
    if not curves:
        raise InputError("has no curves", where=path)
    return curves, deviation


def _bcc(stream: BinaryIO, path: Path) -> tuple[list[Curve], float]:
    header = stream.read(_HEADER.size)
    if len(header) < _HEADER.size:
        raise InputError("is too short for a .bcc file", where=path, hint=_COMPLETE)
    magic, sizes, first, second, dimensions, up, curves, points, _ = _HEADER.unpack(header)
    if magic != b"BCC":
        raise InputError("is not a .bcc file", where=path)
    kind = first + second
    if kind not in _KINDS:
        what = _OTHERS.get(kind, f"curves of the type {kind.decode('latin-1')!r}")
        hint = "save uniform Catmull-Rom curves (C0) or polylines (PL)"
        raise InputError(f"holds {what}, which are not read", where=path, hint=hint)
    if dimensions != 3 or up > 2:
        what = f"holds curves in {dimensions} dimensions of which number {up} points up"
        raise InputError(
            what, where=path, hint="save curves in 3 dimensions, of which number 0, 1 or 2 is up"
        )
    if sizes not in _SIZES:
        what = f"holds numbers of the size code {sizes:#04x}, not of 4 bytes (0x44) or 8 (0x88)"
        raise InputError(what, where=path)
    size = _SIZES[sizes]
    length = os.fstat(stream.fileno()).st_size
    if length != _HEADER.size + size * (curves + 3 * points):
        what = f"has {length:,} bytes, not those of {curves:,} curves with {points:,} points"
        raise InputError(what, where=path, hint=_COMPLETE)
    _check_counts(curves, points, path)
    data = stream.read()
    integers, floats = np.frombuffer(data, f"<i{size}"), np.frombuffer(data, f"<f{size}")
    out: list[Curve | None] = [None] * curves
    deviation = 0.0
    for (count, closed), found in _groups(integers, curves, points, kind, path).items():
        number, start = np.array(found).T
        xyz = floats[start[:, None] + np.arange(3 * count)].reshape(-1, count, 3).astype(np.float64)
        # The dimension that points up becomes the last one; the others keep their order around it.
        xyz = np.roll(xyz, 2 - up, axis=2)
        _check(xyz, number, path)
        control, around = _through(xyz, closed)
        deviation = max(deviation, _deviation(control, around, kind))
        control = np.concatenate([control, np.zeros((*control.shape[:2], 1))], axis=2)
        for k, own in zip(number, control, strict=True):
            out[k] = Curve(own[1:-2], np.zeros(3)) if closed else Curve(own)
    log.info(f"{path.name}: splines deviate from its {_KINDS[kind]} by at most {deviation:.2g} of its units")
    return [curve for curve in out if curve is not None], deviation


def _groups(
    integers: NDArray[np.signedinteger], curves: int, points: int, kind: bytes, path: Path
) -> dict[tuple[int, bool], list[tuple[int, int]]]:
    """(number, first coordinate) of the curves, by their number of points and whether they are closed."""
    groups = defaultdict(list)
    at = total = 0
    for number in range(curves):
        count = int(integers[at]) if at < len(integers) else 0
        total += abs(count)
        if at >= len(integers) or total > points:
            raise InputError(f"ends in curve {number}", where=path, hint=_COMPLETE)
        # A polyline needs no neighbors.
        least = LEAST_POINTS if kind == b"C0" else 3 if count < 0 else 2
        if abs(count) < least:
            raise InputError(f"curve {number} has {abs(count)} points, fewer than {least}", where=path)
        groups[abs(count), count < 0].append((number, at + 1))
        at += 1 + 3 * abs(count)
    if total != points:
        what = f"its curves have {total:,} points, not the {points:,} of its header"
        raise InputError(what, where=path, hint=_COMPLETE)
    return groups


def _through(points: F64, closed: bool) -> tuple[F64, F64]:
    """Control points (k, segments + 3, 3) of the splines through points (k, n, 3), and the points with the
    neighbors of both ends."""
    if closed:
        control = interpolating(points, np.zeros(3))
        control, around = (np.concatenate([p[:, -1:], p, p[:, :2]], axis=1) for p in (control, points))
        return control, around
    from scipy.linalg import solve_banded

    # Straight ends: the second derivative is zero at the first and at the last point.
    k, n, _ = points.shape
    bands = np.array([[1 / 6] * n, [4 / 6] * n, [1 / 6] * n])
    bands[1, [0, -1]], bands[0, 1], bands[2, -2] = 1.0, 0.0, 0.0
    solved = solve_banded((1, 1), bands, points.transpose(1, 0, 2).reshape(n, -1))
    control = solved.reshape(n, k, 3).transpose(1, 0, 2)

    def extended(p: F64) -> F64:
        return np.concatenate([2 * p[:, :1] - p[:, 1:2], p, 2 * p[:, -1:] - p[:, -2:-1]], axis=1)

    return extended(control), extended(points)


def _deviation(control: F64, around: F64, kind: bytes) -> float:
    """Largest distance of splines from the curves through the same points, across the chord of a segment at
    three places: along it, the curves move at other speeds."""
    last = control.shape[1] - 3
    chord = around[:, 2:-1] - around[:, 1:-2]
    chord /= np.maximum(np.linalg.norm(chord, axis=2, keepdims=True), np.finfo(float).tiny)
    largest = 0.0
    for v in (0.25, 0.5, 0.75):
        w = 1.0 - v
        weights = np.array([0.0, w, v, 0.0])
        if kind == b"C0":
            # Catmull and Rom 1974, "A class of local interpolating splines".
            weights += v * w * np.array([-w / 2, 1 - 1.5 * v, 1 - 1.5 * w, -v / 2])
        spline, _ = bases(v)
        gap = np.zeros_like(chord)
        for k in range(4):
            gap += spline[k] * control[:, k : k + last] - weights[k] * around[:, k : k + last]
        gap -= np.sum(gap * chord, axis=2, keepdims=True) * chord
        largest = max(largest, float(np.linalg.norm(gap, axis=2).max()))
    return largest


def _text(stream: BinaryIO, path: Path) -> list[Curve]:
    out: list[Curve] = []
    run: list[list[float]] = []
    points = 0
    for number, line in itertools.chain(lines(stream), [(0, b"")]):
        words = line.split()
        if words:
            run.append(numbers(words))
            points += 1
            if len(run[-1]) != 4:
                shown = reason(line[:40].decode("utf-8", "replace"))
                what = f"line {number} is not x, y, z and radius: '{shown}'"
                hint = "a line holds four numbers, separated by blanks; empty lines separate curves"
                raise InputError(what, where=path, hint=hint)
        elif run:
            out.append(_curve(run, len(out), path))
            run = []
        _check_counts(len(out), points, path)
    return out


def _check_counts(curves: int, points: int, path: Path) -> None:
    if points > MOST_POINTS or curves > MOST_CURVES:
        what = f"has {curves:,} curves with {points:,} points, more than {MOST_CURVES:,} with {MOST_POINTS:,}"
        raise InputError(what, where=path, hint="save fewer curves, or fewer points of each")


def _curve(run: list[list[float]], number: int, path: Path) -> Curve:
    control = np.array(run)
    if len(control) < LEAST_POINTS:
        what = f"curve {number} has {len(control)} points, fewer than {LEAST_POINTS}"
        raise InputError(what, where=path)
    _check(control[None], np.array([number]), path)
    if (control[:, 3] <= 0).any():
        raise InputError(f"curve {number} has a radius that is not positive", where=path)
    return Curve(control)


def _check(points: F64, number: NDArray[np.int_], path: Path) -> None:
    """Refuse points (k, n, ...) of curves (k,) that are not finite, or too large."""
    # NaN compares false.
    wrong = ~(np.abs(points) <= _MOST).all(axis=(1, 2))
    if wrong.any():
        what = f"curve {number[wrong][0]} has points that are not finite numbers below {_MOST:g}"
        raise InputError(what, where=path)
