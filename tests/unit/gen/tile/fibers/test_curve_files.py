"""Files of yarns and fibers: what is read, and that nothing else raises but one clear line."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fuzzing import damaged, loads_or_refuses

from mbtf_core.errors import InputError
from mbtf_gen.tile.fibers import curve_file, weave
from mbtf_gen.tile.fibers.cloth_file import CURVE_FILES
from mbtf_gen.tile.fibers.curve_file import read_curves
from mbtf_gen.tile.fibers.weave import read_pattern
from mbtf_gen.tile.loading import load_material

PYP = """*pattern
0.004 0.002 0.0003 1
*Q
0.0005 0.0005 0 0
0.0015 0.0005 0.0002 0
0.0025 0.0005 0 0
0.0035 0.0005 -0.0002 0
*E
0 1 0 0
1 2 0 0
2 3 0 0
3 0 1 0
"""
CURVES = "0 0 0 .1\n1 0 0 .1\n2 0 0 .1\n3 0 0 .1\n\n\n0 1 0 .2\n1 1 0 .2\n2 1 0 .2\n3 1 0 .2\n4 1 0 .2\n"


def bcc(lines: list[tuple[np.ndarray, bool]], up: int = 2, **changes: object) -> bytes:
    fields: dict[str, object] = {"magic": b"BCC", "sizes": 0x44, "kind": b"C0", "dimensions": 3}
    fields |= {"up": up, "curves": len(lines), "points": sum(len(p) for p, _ in lines)} | changes
    header = struct.pack("<3sB2sBBQQ40s", *fields.values(), b"test")
    size = 8 if fields["sizes"] == 0x88 else 4
    counts = [np.array(-len(p) if closed else len(p), f"<i{size}") for p, closed in lines]
    body = (
        count.tobytes() + p.astype(f"<f{size}").tobytes() for count, (p, _) in zip(counts, lines, strict=True)
    )
    return header + b"".join(body)


def fails(path: Path, read: object = read_curves) -> str:
    with pytest.raises(InputError) as error:
        read(path)  # type: ignore[operator]
    assert "\n" not in error.value.what
    return error.value.what


def test_a_pattern_has_the_yarns_of_its_edges(tmp_path: Path) -> None:
    path = tmp_path / "a.pyp"
    path.write_text(PYP)
    pattern = read_pattern(path)
    assert (pattern.aspect, pattern.radius) == pytest.approx((0.5, 0.075))
    (yarn,) = pattern.yarns
    assert yarn.shift.tolist() == [1, 0]
    assert yarn.points[:, 0] == pytest.approx([0.125, 0.375, 0.625, 0.875])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("0.004 0.002", "-0.004 0.002", "positive"),
        ("0.0015 0.0005 0.0002 0", "0.0015 nan 0.0002 0", "line 5"),
        ("3 0 1 0", "3 9 1 0", "beyond"),
        ("3 0 1 0", "3 2 1 0", "closed yarns"),
        ("3 0 1 0", "3 0 100000000 0", "indices"),
        ("3 0 1 0", "3 0 90 0", "periods"),
        ("0.0015 0.0005 0.0002 0", "0.0005 0.0005 0 0", "same place"),
        ("0.0003 1", "1_0 1", "line 2"),
    ],
)
def test_damaged_patterns_are_refused(tmp_path: Path, old: str, new: str, says: str) -> None:
    path = tmp_path / "a.pyp"
    assert PYP.count(old)
    path.write_text(PYP.replace(old, new, 1))
    assert says in fails(path, read_pattern)


def test_a_bcc_has_open_and_closed_curves_through_its_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points, ring = rng.random((6, 3)), rng.random((5, 3))
    path = tmp_path / "a.bcc"
    for up, sizes in ((2, 0x44), (1, 0x88)):
        path.write_bytes(bcc([(points, False), (ring, True)], up, sizes=sizes))
        (first, second), _ = read_curves(path)
        order = [0, 1, 2] if up == 2 else [2, 0, 1]
        assert first.shift is None
        at = first.at(np.arange(6.0))[0][:, :3]
        assert np.abs(at - points[:, order]).max() < 1e-6
        at = second.at(np.arange(6.0))[0][:, :3]
        assert np.abs(at - ring[:, order][[0, 1, 2, 3, 4, 0]]).max() < 1e-6


def test_a_bcc_may_hold_polylines(tmp_path: Path) -> None:
    """The spline around a unit circle deviates from n chords by their height 1 - cos(π/n)."""
    t = 2.0 * np.pi * np.arange(32) / 32
    ring = np.column_stack([np.cos(t), np.sin(t), 0.0 * t])
    piece = np.array([[0.0, 1.0, 2.0], [3.0, 5.0, 4.0]])
    path = tmp_path / "a.bcc"
    path.write_bytes(bcc([(ring, True), (piece, False)], kind=b"PL"))
    (circle, line), deviation = read_curves(path)
    assert np.abs(circle.at(np.arange(33.0))[0][:, :3] - np.concatenate([ring, ring[:1]])).max() < 1e-6
    at = line.at(np.linspace(0.0, 1.0, 5))[0][:, :3]
    assert np.abs(at - np.linspace(piece[0], piece[1], 5)).max() < 1e-6
    assert deviation == pytest.approx(1.0 - np.cos(np.pi / 32), rel=0.02)


def test_what_is_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curve_file, "MOST_CURVES", 1)
    monkeypatch.setattr(weave, "_MOST_VERTICES", 3)
    (tmp_path / "a.bcc").write_bytes(bcc([(np.random.default_rng(0).random((6, 3)), False)] * 2))
    (tmp_path / "a.curves").write_text(CURVES)
    (tmp_path / "a.pyp").write_text(PYP)
    for name, read in (("a.bcc", read_curves), ("a.curves", read_curves), ("a.pyp", read_pattern)):
        assert "more than" in fails(tmp_path / name, read)


def test_text_has_control_points_and_radii(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbf" + CURVES.replace("\n", "\r\n").encode())
    (first, second), _ = read_curves(path)
    assert (len(first.control), len(second.control)) == (4, 5)
    assert len(load_material(path).curves) == 2
    assert second.control[4].tolist() == [4, 1, 0, 0.2]


SAMPLES = {
    ".pyp": PYP.encode(),
    ".curves": CURVES.encode(),
    ".bcc": bcc([(np.random.default_rng(0).random((6, 3)), False)]),
}


@given(data=st.data())
@settings(max_examples=150)
def test_damaged_files(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    kind, content = data.draw(damaged(SAMPLES))
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / f"a{kind}").write_bytes(content)
    path = folder / "cloth.yaml"
    path.write_text(f"{CURVE_FILES[kind]}: a{kind}\nyarn: {{fibers: 1, flyaways: 0}}\n")
    material = loads_or_refuses(lambda: load_material(path))
    assert material is None or np.isfinite(material.thickness)
