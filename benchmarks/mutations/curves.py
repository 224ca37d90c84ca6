"""Curves (.curves and .bcc) and periodic yarns (.pyp)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import F64, Case, Draws, Rng, damaged


def make(rng: Rng, folder: Path) -> Case:
    """Some fibers as B-splines in text, or as curves through points in a BCC file."""
    d = Draws(rng)
    runs = [_fiber(rng) for _ in range(int(rng.integers(2, 6)))]
    return _text(runs, folder, d) if d.chance(0.5) else _bcc(runs, folder, d)


def _fiber(rng: Rng) -> F64:
    """Points (n, 3) of a fiber that runs up or across."""
    n = int(rng.integers(5, 9))
    along = np.linspace(0, rng.uniform(2, 4), n)
    points = np.stack([along, rng.uniform(0, 2) + 0.1 * rng.normal(size=n), 0.1 * rng.normal(size=n)], axis=1)
    return np.round(points[:, [1, 0, 2]] if rng.random() < 0.5 else points, 3)


def _agree(tile: Any, expected: list[F64], radius: F64 | float, width: float, aspect: float) -> bool:
    """Whether the fibers pass through points (n, 3), relative to their bounds and highest point."""
    if len(tile.curves) != len(expected) or abs(tile.aspect - aspect) > 1e-5 * aspect:
        return False
    low = np.concatenate(expected).min(axis=0)
    rise = None
    for curve, points, wide in zip(
        tile.curves, expected, np.broadcast_to(radius, len(expected)), strict=True
    ):
        dense = curve.at(np.linspace(0, len(curve.windows()), 4000))[0]
        wanted = np.column_stack([(points - low)[:, :2], points[:, 2]]) / width
        rise = dense[0, 2] - wanted[0, 2] if rise is None else rise
        wanted[:, 2] += rise
        # Readers are free to place their control points: the file's points lie on the curve, in their order.
        distance = np.linalg.norm(dense[:, None, :3] - wanted, axis=-1)
        if distance.min(axis=0).max() > 2e-3 or (np.diff(distance.argmin(axis=0)) < 0).any():
            return False
        if abs(dense[:, 3].mean() - wide) > 1e-6 + 1e-3 * wide:
            return False
    return True


def _text(runs: list[F64], folder: Path, d: Draws) -> Case:
    """Mitsuba's text: x, y, z and the radius of a control point in each line."""
    radii = np.round(d.rng.uniform(0.002, 0.05, len(runs)), 4)
    style = d.pick(("plain", "CRLF", "tabs", "exponents", "BOM", "blank lines"), "written")
    how = (
        d.pick(("NaN", "radius 0", "radius -1", "3 numbers", "3 points", "1e30", "words", "comment"))
        if d.chance(0.3)
        else ""
    )
    rows = [[[*p, r] for p in points] for points, r in zip(runs, radii, strict=True)]
    refuse = bool(how) and how != "comment"
    if how == "NaN":
        rows[0][1][2] = np.nan
    elif how.startswith("radius"):
        rows[-1][2][3] = float(how.split()[1])
    elif how == "3 numbers":
        rows[0] = [row[:3] for row in rows[0]]
    elif how == "3 points":
        rows[0] = rows[0][:3]
    elif how == "1e30":
        rows[0][0][0] = 1e30
    number = "{:.6e}" if style == "exponents" else "{:.6g}"
    lines = [
        ("\t" if style == "tabs" else " ").join(number.format(v) for v in row)
        for run in rows
        for row in [*run, []]
    ]
    if how == "words":
        lines[1] = "a b c d"
    elif how == "comment":
        lines.insert(0, "# x y z r")
    if style == "blank lines":
        lines = ["", "", *lines, "", ""]
    text = ("\r\n" if style == "CRLF" else "\n").join(lines)
    path = folder / "f.curves"
    path.write_bytes(("\ufeff" if style == "BOM" else "").encode() + text.encode())
    through = [(p[:-2] + 4 * p[1:-1] + p[2:]) / 6 for p in runs]
    size = np.ptp(np.concatenate(through), axis=0)
    d.words.append(how)
    return Case(
        path,
        ", ".join(d.words),
        lambda tile: _agree(tile, through, radii / size[0], size[0], size[1] / size[0]),
        refuse,
        valid=not how,
    )


def _bcc(runs: list[F64], folder: Path, d: Draws) -> Case:
    """The binary curve collection: counts of points, negative ones of closed curves, and their points."""
    up = d.pick((2, 2, 1, 0), "up")
    sizes, kind, count, total = 0x44, b"0", len(runs), sum(map(len, runs))
    numbers = "<f4"
    if d.chance(0.15, "8-byte numbers"):
        sizes, numbers = d.pick((0x48, 0x84, 0x88)), "<f8"
    if d.chance(0.15):
        kind = d.pick((b"1", b"P", b"\0"), "type")
    how = (
        d.pick(("curves 3e8", "points 3e8", "points +1", "count -2**31", "count 3e8", "NaN", "dimension 2"))
        if d.chance(0.25)
        else ""
    )
    d.words.append(how)
    body: list[Any] = []
    for points in runs:
        # The dimension that points up is stored in its place; the others follow in order.
        stored = np.roll(points, up - 2, axis=1)
        body.append((len(points), stored.astype(numbers)))
    if how == "NaN":
        body[0][1][0, 0] = np.nan
    count = 300_000_000 if how == "curves 3e8" else count
    total = {"points 3e8": 300_000_000, "points +1": total + 1}.get(how, total)
    if how.startswith("count"):
        body[0] = (-(2**31) if "-" in how else 300_000_000, body[0][1])
    head = struct.pack(
        "<3sBccBBQQ40s",
        b"BCC",
        sizes,
        b"C",
        kind,
        2 if how == "dimension 2" else 3,
        up,
        count,
        total,
        b"made",
    )
    width = "<q" if sizes & 0x80 else "<i"
    if sizes == 0x84:
        body = [[n, a.astype("<f4")] for n, a in body]
    path = folder / "f.bcc"
    path.write_bytes(head + b"".join(struct.pack(width, n) + a.tobytes() for n, a in body))
    size = np.ptp(np.concatenate(runs), axis=0)
    return Case(
        path,
        ", ".join(d.words),
        lambda tile: _agree(tile, runs, 0.002, size[0], size[1] / size[0]),
        bool(how) or kind == b"\0",
        valid=not how and kind == b"0" and sizes == 0x44,
    )


def pattern(rng: Rng, folder: Path) -> Case:
    """Wavy yarns along x and straight ones along y as a periodic yarn pattern."""
    d = Draws(rng)
    px, py = d.number(0.5, 3, "px"), d.number(0.5, 3, "py")
    radius = d.number(0.01, 0.03, "radius")
    n, each = int(rng.integers(1, 4)), 12
    s = (np.arange(each) + 0.5) / each
    rows: list[Any] = []
    edges: list[list[float]] = []
    for yarn in range(n):
        z = 0.05 * px * np.sin(2 * np.pi * s)
        rows += [[px * t, (yarn + 0.5) / n * py, h, 0.0] for t, h in zip(s, z, strict=True)]
        first = yarn * each
        edges += [[first + k, first + (k + 1) % each, int(k == each - 1), 0] for k in range(each)]
    head: list[Any] = [px, py, radius, len(rows)]
    how = (
        d.pick(("NaN", "radius -1", "px 0", "py 1e9", "edge 999", "half edge", "no *E", "open"))
        if d.chance(0.35)
        else ""
    )
    d.words.append(how)
    if how == "NaN":
        rows[3][1] = np.nan
    elif how in ("radius -1", "px 0", "py 1e9"):
        head[("px", "py", "radius").index(how.split()[0])] = float(how.split()[1])
    elif how == "edge 999":
        edges[2][1] = 999
    elif how == "half edge":
        edges[2][1] += 0.5
    elif how == "open":
        edges.pop()
    sections = {
        "*pattern # px py radius n": [head],
        "*Q # x y z t": rows,
        "*E # v0 v1 dx dy": edges,
        "*RL": [[0.1]] * len(rows),
    }
    if how == "no *E":
        del sections["*E # v0 v1 dx dy"]
    # A material file of few fibers, as thousands take seconds.
    path = folder / "material.yaml"
    path.write_text("pattern: p.pyp\nyarn: {fibers: 3, flyaways: 0}\n")
    (folder / "p.pyp").write_text(
        "\n".join(
            "\n".join([name, *(" ".join(f"{v:.9g}" for v in row) for row in lines), ""])
            for name, lines in sections.items()
        )
    )

    def check(tile: Any) -> bool:
        mean = np.mean([c.control[:, 1].mean() % tile.aspect for c in tile.curves])
        thick = 0.1 + 2 * radius / px
        return (
            abs(tile.aspect - py / px) < 1e-6
            and abs(mean / tile.aspect - 0.5) < 0.1
            and 0.5 * thick < tile.thickness < 2 * thick
        )

    # A period of 10^9 is far from its yarns, but is one.
    return Case(
        path,
        ", ".join(d.words),
        check if how != "py 1e9" else lambda _: None,
        bool(how) and how != "py 1e9",
        valid=not how,
    )


def damage(rng: Rng, folder: Path) -> Case:
    """Any of these with damaged bytes."""
    d = Draws(rng)
    case = d.pick((make, make, pattern))(rng, folder)
    file = next(p for p in sorted(folder.iterdir()) if p.suffix != ".yaml")
    file.write_bytes(damaged(file.read_bytes(), d))
    return Case(case.path, f"{case.text}; {', '.join(d.words)}")
