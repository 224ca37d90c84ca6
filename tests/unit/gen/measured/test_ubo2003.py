"""Photographs named by their directions, in folders and archives."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support import measured_files as files

from mbtf_core.errors import InputError
from mbtf_gen.measured.ubo2003 import Ubo2003

UP = files.unit([(0, 0)])[0]


def check(btf: Ubo2003) -> None:
    """The known function at every pair, at a texel of each quarter, in a shuffled order."""
    assert (btf.rows, btf.columns, btf.left_out, btf.cosine) == (16, 24, 3, None)
    assert len(btf.light) == 9
    pair, quarter = (a.ravel() for a in np.mgrid[:9, :4])
    order = np.random.default_rng(1).permutation(36)
    pair, row, column = pair[order], quarter[order] // 2, quarter[order] % 2
    values = btf.values(pair, (3 + 8 * row) * 24 + 5 + 12 * column)
    light, view = btf.light[pair].astype(np.float64), btf.view[pair].astype(np.float64)
    # JPEG rounds, and a code is up to 0.9% of the value 1.
    np.testing.assert_allclose(values, files.value(2 * row, 2 * column, light, view), atol=0.012)


def test_a_folder_and_archives(tmp_path: Path) -> None:
    check(Ubo2003(files.write_folder(tmp_path / "a", files.photographs())))
    for method in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        content = files.zipped(files.photographs() | {"read me.txt": b"hello"}, method)
        (tmp_path / "a.zip").write_bytes(content)
        check(Ubo2003(tmp_path / "a.zip"))


def test_png_is_exact(tmp_path: Path) -> None:
    light, view = files.unit([(30, 20)])[0], files.unit([(45, 60)])[0]
    name = "tl030_pl020_tv045_pv060.png"
    btf = Ubo2003(files.write_folder(tmp_path, {name: files.encoded(light, view, "PNG")}))
    c = files.codes(light, view).reshape(-1, 3) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    texels = np.arange(16 * 24)
    np.testing.assert_allclose(btf.values(np.zeros_like(texels), texels), linear, rtol=1e-6)
    np.testing.assert_allclose(btf.light[0], light, atol=1e-6)
    np.testing.assert_allclose(btf.view[0], view, atol=1e-6)


NAME = "tl030_pl020_tv045_pv060"
LINEAR = np.array([[[0.25, 1.5, 0.003], [8.0, 0.5, 0.0]], [[1.0, 2.0, 4.0], [0.125, 0.75, 3.0]]], np.float32)


def radiance(linear: NDArray[np.float32], header: bytes = b"FORMAT=32-bit_rle_rgbe\n") -> bytes:
    """A Radiance picture: a mantissa of 8 bits for each color, and an exponent for all three."""
    mantissa, exponent = np.frexp(linear.max(axis=-1))
    codes = np.floor(linear * (256 * mantissa / linear.max(axis=-1))[..., None])
    pixels = np.concatenate([codes, exponent[..., None] + 128], axis=-1).astype(np.uint8)
    size = b"\n-Y %d +X %d\n" % linear.shape[:2]
    return b"#?RADIANCE\n" + header + size + pixels.tobytes()


def exr(tmp_path: Path, linear: NDArray[np.float32]) -> bytes:
    import OpenEXR

    OpenEXR.File({}, {"RGB": linear}).write(str(tmp_path / "a.exr"))
    return (tmp_path / "a.exr").read_bytes()


def values_of(path: Path) -> NDArray[np.float32]:
    """All values of the only pair, as an image."""
    btf = Ubo2003(path)
    values = btf.values(np.zeros(btf.rows * btf.columns, np.int64), np.arange(btf.rows * btf.columns))
    return values.reshape(btf.rows, btf.columns, 3)


@pytest.mark.parametrize("suffix", ["hdr", "HDR", "exr"])
@pytest.mark.parametrize("zipped", [False, True])
def test_photographs_of_floats_are_linear(suffix: str, zipped: bool, tmp_path: Path) -> None:
    content = exr(tmp_path, LINEAR) if suffix == "exr" else radiance(LINEAR)
    path = files.write_folder(tmp_path / "folder", {f"tv/{NAME}.{suffix}": content})
    if zipped:
        path = tmp_path / "a.zip"
        path.write_bytes(files.zipped({f"CEILING/{NAME}.{suffix}": content}))
    # The colors of a Radiance pixel are rounded to 1/128 of the largest.
    atol = 0 if suffix == "exr" else LINEAR.max(axis=-1, keepdims=True) / 128
    assert (np.abs(values_of(path) - LINEAR) <= atol).all()


def good(name: str = "tl000 pl000 tv000 pv000.jpg") -> dict[str, bytes]:
    return {name: files.encoded(UP, UP)}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"a.jpg": b"x"}, "named by their directions"),
        ({"tl000 pl000 tv000 pv000.jpg": b"not an image"}, "cannot be decoded"),
        ({"tl095 pl000 tv000 pv000.jpg": b""}, "above the horizon"),
        (good() | good("b/tl000 pl000 tv000 pv000.jpg"), "the same directions"),
        ({f"{NAME}.bmp": b""}, ".jpg, .jpeg, .png, .exr, .hdr are read"),
    ],
)
@pytest.mark.parametrize("zipped", [False, True])
def test_refused(content: dict[str, bytes], message: str, zipped: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    if zipped:
        path.write_bytes(files.zipped(content))
    else:
        path = files.write_folder(tmp_path / "a", content)
    with pytest.raises(InputError, match=message):
        Ubo2003(path)


def test_archives_that_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"
    path.write_bytes(files.zipped({"tl000 pl000 tv000 pv000.jpg": bytes(10**7)}, zipfile.ZIP_DEFLATED))
    with pytest.raises(InputError, match="claims 10,000,000 bytes in"):
        Ubo2003(path)
    whole = files.zipped(good())
    # Cut, and with a byte changed within the image: its checksum differs.
    flipped = whole[:200] + bytes([whole[200] ^ 1]) + whole[201:]
    for content in (whole[:4], whole[: len(whole) // 2], whole[:-1], flipped):
        path.write_bytes(content)
        with pytest.raises(InputError, match="check that the file is complete"):
            Ubo2003(path)
    # The flag of encryption, in the table at the end.
    at = whole.index(b"PK\1\2") + 8
    path.write_bytes(whole[:at] + bytes([whole[at] | 1]) + whole[at + 1 :])
    with pytest.raises(InputError, match=r"(?s)encrypted.*unpack it and give the folder"):
        Ubo2003(path)


def test_links_out_of_the_folder_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret.jpg").write_bytes(files.encoded(UP, UP))
    folder = files.write_folder(tmp_path / "a", good())
    os.symlink(tmp_path / "secret.jpg", folder / "tl010 pl000 tv000 pv000.jpg")
    assert len(Ubo2003(folder).light) == 1
    (folder / "tl020 pl000 tv000 pv000.jpg").symlink_to("tl020 pl000 tv000 pv000.jpg")
    with pytest.raises(InputError, match="cannot be read"):
        Ubo2003(folder).values(np.array([1]), np.array([0]))
