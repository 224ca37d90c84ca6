"""Bonn's DFMF files: values of a known function, and files that are refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from support import measured_files as files

from mbtf_core.errors import InputError
from mbtf_gen.measured.ubo2014 import Ubo2014

PAIRS, TEXELS = 9, files.ROWS * files.COLUMNS


def opened(folder: Path, content: bytes) -> Ubo2014:
    path = folder / "a.btf"
    path.write_bytes(content)
    return Ubo2014(path)


def all_values(btf: Ubo2014) -> tuple[np.ndarray, np.ndarray]:
    """Values of all pairs and texels, and what they should be, in a shuffled order."""
    order = np.random.default_rng(3).permutation(PAIRS * TEXELS)
    pair, texel = order // TEXELS, order % TEXELS
    light, view = btf.light[pair].astype(np.float64), btf.view[pair].astype(np.float64)
    row, column = np.divmod(texel, btf.columns)
    return btf.values(pair, texel), files.value(row, column, light, view)


@pytest.mark.parametrize(
    ("model", "width", "tolerance"),
    [*((m, 4, 2e-4) for m in (0, 1, 3, 4, 9, 11, 12)), (0, 2, 5e-3), (0, 8, 1e-5)],
)
@pytest.mark.parametrize("transposed", [False, True])
def test_the_known_function(
    model: int, width: int, tolerance: float, transposed: bool, tmp_path: Path
) -> None:
    btf = opened(tmp_path, files.btf(model, width, transposed))
    assert (btf.rows, btf.columns, btf.left_out, btf.cosine) == (files.ROWS, files.COLUMNS, 3, True)
    values, expected = all_values(btf)
    np.testing.assert_allclose(values, expected, rtol=tolerance, atol=tolerance / 100)


@pytest.mark.parametrize(
    ("version", "cosine", "said"), [(1, 0, None), (2, 0, False), (3, 1, True), (4, 0, False)]
)
def test_versions_of_the_header(version: int, cosine: int, said: bool | None, tmp_path: Path) -> None:
    btf = opened(tmp_path, files.btf(version=version, cosine=cosine))
    assert btf.cosine is said
    values, expected = all_values(btf)
    np.testing.assert_allclose(values, expected, rtol=1e-4)


def test_another_reader_reads_the_same_factors(tmp_path: Path) -> None:
    module = pytest.importorskip("pysmtb.btf")
    path = tmp_path / "a.btf"
    # It reads three of the nine numbers of a rotation; the published files have none.
    path.write_bytes(files.btf(0, 4, rotations=0))
    meta, data = module.read_ubo_btf_dfmf(str(path))
    # Of view 1, light 2: its rows are `view · lights + light`, its columns row-major.
    pictures = np.stack([data.SxV[c] @ data.U[c][1 * 3 + 2] for c in range(3)], axis=-1)
    btf = Ubo2014(path)
    ours = btf.values(np.full(TEXELS, 5), np.arange(TEXELS))
    np.testing.assert_allclose(ours, pictures, rtol=1e-5)
    np.testing.assert_allclose(np.array(meta.views_3d)[:3], btf.view[::3], atol=1e-6)
    assert (meta.width, meta.height, bool(meta.cosine_in_data)) == (btf.columns, btf.rows, btf.cosine)


def patched(content: bytes, at: int, new: bytes) -> bytes:
    return content[:at] + new + content[at + len(new) :]


def broken() -> dict[str, bytes]:
    """Part of the message → file."""
    good = files.btf()
    views = good.index(struct.pack("<I", 4) + np.deg2rad(files.VIEWS[0]).astype("<f4").tobytes())
    size = good.index(struct.pack("<II", files.COLUMNS, files.ROWS))
    model = size + 8 + 40 + 4
    factors = model + 4 + 48
    huge = struct.pack("<I", 1_000_000_000)
    return {
        "is not a Bonn BTF": b"PNG" + good,
        "of the kind '!FMF12FCER'": b"!FMF12FCER" + good[10:],
        "the version 9": patched(good, 14, struct.pack("<I", 9)),
        "header of": patched(good, 10, struct.pack("<I", 99)),
        "claims 1,000,000,000 views": patched(good, views, huge),
        "lights of view 1": patched(good, views + 16 + 24 + 8, struct.pack("<I", 2)),
        "NaN or infinite numbers in its directions": patched(good, views + 4, struct.pack("<f", np.nan)),
        "claims images of 1000000000 x 5 texels": patched(good, size, huge),
        "ends within the rotations": patched(good, size + 8, huge),
        "the color model 2": patched(good, model, struct.pack("<i", 2)),
        "numbers of 3 bytes": patched(good, factors, b"\3"),
        "claims 1,000,000,000 components": patched(good, factors + 1, huge),
        "not those of 12 pairs and 20 texels": patched(good, factors + 5, struct.pack("<I", 13)),
        "ends within the factors of channel 2": good[:-1],
        "3 bytes after": good + b"abc",
    }


@pytest.mark.parametrize("message", sorted(broken()))
def test_refused(message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.btf") as caught:
        opened(tmp_path, broken()[message])
    assert message in caught.value.what


def test_nan_factors_are_refused_where_they_are_used(tmp_path: Path) -> None:
    btf = opened(tmp_path, patched(files.btf(), len(files.btf()) - 4, struct.pack("<f", np.nan)))
    btf.values(np.array([0]), np.array([0]))
    with pytest.raises(InputError, match="NaN or infinite"):
        btf.values(np.array([0, 1]), np.array([TEXELS - 1, 0]))
