"""Curves as text (.curves) and as binary collections (.bcc)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import F64, Case, Draws


def make(d: Draws, folder: Path) -> Case:
    """Some fibers as B-splines in text, or as curves through points in a BCC file."""
    runs = []
    for _ in range(int(d.rng.integers(2, 6))):
        n = int(d.rng.integers(5, 9))
        side, up = d.rng.normal(0, 0.1, (2, n))
        points = np.stack([np.linspace(0, d.rng.uniform(2, 4), n), side + d.rng.uniform(0, 2), up], axis=1)
        runs.append(np.round(points[:, [1, 0, 2]] if d.chance(0.5) else points, 3))
    return (_text if d.chance(0.5) else _bcc)(runs, folder, d)


def _agree(tile: Any, expected: list[F64], radii: F64) -> bool:
    """Whether the fibers pass through points (n, 3), relative to their bounds and the first one's height."""
    low, size = np.concatenate(expected).min(axis=0), np.ptp(np.concatenate(expected), axis=0)
    if len(tile.curves) != len(expected) or abs(tile.aspect * size[0] / size[1] - 1) > 1e-5:
        return False
    rise = None
    for curve, points, radius in zip(tile.curves, expected, radii / size[0], strict=True):
        dense = curve.at(np.linspace(0, len(curve.windows()), 4000))[0]
        wanted = (points - low * (1, 1, 0)) / size[0]
        rise = dense[0, 2] - wanted[0, 2] if rise is None else rise
        # Readers are free to place their control points: the file's points lie on the curve, in their order.
        distance = np.linalg.norm(dense[:, None, :3] - wanted - (0, 0, rise), axis=-1)
        if distance.min(axis=0).max() > 2e-3 or (np.diff(distance.argmin(axis=0)) < 0).any():
            return False
        if abs(dense[:, 3].mean() - radius) > 1e-6 + 1e-3 * radius:
            return False
    return True


def _text(runs: list[F64], folder: Path, d: Draws) -> Case:
    """Mitsuba's text: x, y, z and the radius of a control point in each line."""
    radii = np.round(d.rng.uniform(0.002, 0.05, len(runs)), 4)
    style = d.pick(("plain", "CRLF", "tabs", "exponents", "BOM", "blank lines"), "written")
    rows = [np.column_stack([p, np.full(len(p), r)]).tolist() for p, r in zip(runs, radii, strict=True)]
    faults = {"NaN": np.nan, "radius 0": 0.0, "radius -1": -1.0, "1e30": 1e30}
    how = d.fault(0.3, *faults, "3 numbers", "3 points", "words", "comment")
    if how in faults:
        rows[-1][2][3 if "radius" in how else 0] = faults[how]
    elif how == "3 numbers":
        rows[0] = [row[:3] for row in rows[0]]
    elif how == "3 points":
        rows[0] = rows[0][:3]
    space, number = "\t" if style == "tabs" else " ", "{:.6e}" if style == "exponents" else "{:.6g}"
    lines = [space.join(map(number.format, row)) for run in rows for row in [*run, []]]
    if how in ("words", "comment"):
        lines.insert(2, {"words": "a b c d", "comment": "# x y z r"}[how])
    if style == "blank lines":
        lines = ["", "", *lines, "", ""]
    text = "\ufeff" * (style == "BOM") + ("\r\n" if style == "CRLF" else "\n").join(lines)
    (folder / "f.curves").write_bytes(text.encode())
    through = [(p[:-2] + 4 * p[1:-1] + p[2:]) / 6 for p in runs]
    refuse = how not in ("", "comment")
    return Case(folder / "f.curves", lambda tile: _agree(tile, through, radii), refuse, valid=not how)


def _bcc(runs: list[F64], folder: Path, d: Draws) -> Case:
    """The binary curve collection: counts of points, negative ones of closed curves, and their points."""
    up, sizes = d.pick((2, 2, 1, 0), "up"), d.pick((0x44, 0x44, 0x44, 0x48, 0x84, 0x88), "sizes")
    kind = d.pick((b"0", b"0", b"0", b"0", b"1", b"P", b"\0"), "type")
    faults = ("curves", "total", "count", "total + 1", "negative count", "NaN", "dimension 2")
    how = d.fault(0.25, *faults)
    many, counts, total = 300_000_000, [len(p) for p in runs], sum(map(len, runs))
    if "count" in how:
        counts[0] = -(2**31) if "negative" in how else many
    total = {"total": many, "total + 1": total + 1}.get(how, total)
    head = (sizes, b"C", kind, 2 if how == "dimension 2" else 3, up, many if how == "curves" else len(runs))
    data = struct.pack("<3sBccBBQQ40s", b"BCC", *head, total, b"made")
    for count, points in zip(counts, runs, strict=True):
        # The dimension that points up is stored in its place; the others follow in order.
        stored = np.roll(points, up - 2, axis=1)
        stored[0, 0] = np.nan if how == "NaN" else stored[0, 0]
        data += struct.pack("<q" if sizes & 0x80 else "<i", count)
        data += stored.astype("<f8" if sizes & 0x08 else "<f4").tobytes()
    (folder / "f.bcc").write_bytes(data)
    radii = np.full(len(runs), 0.002 * np.ptp(np.concatenate(runs)[:, 0]))
    valid = not how and kind == b"0" and sizes == 0x44
    refuse = bool(how) or kind == b"\0"
    return Case(folder / "f.bcc", lambda tile: _agree(tile, runs, radii), refuse, valid=valid)
