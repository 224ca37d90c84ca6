"""Color spaces that files declare, against published matrices and LittleCMS; pictures of the whole sphere."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms
from PIL import Image as Pillow
from support.image_files import P3_COLUMNS, SRGB_CURVE, exr, icc, png, rng

from mbtf_core.color import linear_to_srgb, srgb_to_linear
from mbtf_core.errors import InputError
from mbtf_core.images.environment import read_environment
from mbtf_core.images.read import linear_rgb, read_image

ACESCG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
# Published by colour-science for Bradford's adaptation.
FROM_ACESCG = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
FROM_P3 = [[1.2249, -0.2249, 0.0], [-0.0421, 1.0421, 0.0], [-0.0196, -0.0786, 1.0983]]
P3_CHRM = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)


def table(exponent: float, count: int) -> bytes:
    values = np.round(65535 * np.linspace(0, 1, count) ** exponent).astype(">u2")
    return b"curv\0\0\0\0" + struct.pack(">I", count) + values.tobytes()


def para(kind: int, *numbers: float) -> bytes:
    return (
        b"para\0\0\0\0"
        + struct.pack(">HH", kind, 0)
        + struct.pack(f">{len(numbers)}i", *(round(65536 * n) for n in numbers))
    )


def chrm(values: tuple[float, ...]) -> tuple[bytes, bytes]:
    red, green, blue, white = zip(values[::2], values[1::2], strict=True)
    numbers = (*white, *red, *green, *blue)
    return b"cHRM", struct.pack(">8I", *(round(100_000 * n) for n in numbers))


@pytest.mark.parametrize(
    "curve",
    [
        SRGB_CURVE,
        table(1.8, 1024),
        b"curv\0\0\0\0" + struct.pack(">IHH", 1, round(2.2 * 256), 0),
        para(0, 2.2),
        para(1, 2.4, 0.95, 0.05),
        para(2, 2.4, 0.9, 0.05, 0.02),
        para(4, 2.4, 0.94, 0.05, 0.08, 0.05, 0.01, 0.001),
    ],
)
def test_profiles_agree_with_littlecms(tmp_path: Path, curve: bytes) -> None:
    codes = rng().integers(60, 200, (16, 16, 3)).astype(np.uint8)
    profile = icc("Test P3", P3_COLUMNS, curve)
    srgb = ImageCms.createProfile("sRGB")
    opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    expected = np.asarray(ImageCms.profileToProfile(Pillow.fromarray(codes), opened, srgb, 1), float)
    Pillow.fromarray(codes).save(tmp_path / "x.png", icc_profile=profile)
    Pillow.fromarray(codes).save(tmp_path / "x.tif", icc_profile=profile)
    deep = (b"iCCP", b"x\0\0" + zlib.compress(profile))
    png(tmp_path / "deep.png", codes.astype(int) * 257, 2, 16, extra=(deep,))
    for name in ("x.png", "x.tif", "deep.png"):
        found = linear_rgb(read_image(tmp_path / name))
        assert np.abs(255 * linear_to_srgb(np.clip(found, 0, 1)) - expected).max() < 1.6, name


def test_profiles_of_gray_and_of_floats(tmp_path: Path) -> None:
    codes = rng().integers(0, 256, (8, 8)).astype(np.uint8)
    Pillow.fromarray(codes).save(tmp_path / "g.png", icc_profile=icc("Gray 1.8", (), para(0, 1.8), gray=True))
    expected = np.repeat((codes[..., None] / 255.0) ** 1.8, 3, axis=2)
    assert linear_rgb(read_image(tmp_path / "g.png")) == pytest.approx(expected, abs=1e-4)
    # A curve to Lab is one of lightness.
    lab = icc("L*", (), para(0, 1.0), gray=True).replace(b"GRAYXYZ ", b"GRAYLab ")
    Pillow.fromarray(codes).save(tmp_path / "g.png", icc_profile=lab)
    assert read_image(tmp_path / "g.png").tags.foreign is not None
    # Another library than Pillow reads floats of three channels.
    numbers = rng().random((8, 8, 3)).astype(np.float32)
    profile = icc("P3 linear", P3_COLUMNS, para(0, 1.0))
    tifffile.imwrite(tmp_path / "f.tif", numbers, photometric="rgb", iccprofile=profile)
    found = linear_rgb(read_image(tmp_path / "f.tif"))
    assert found == pytest.approx(numbers @ np.array(FROM_P3).T, abs=3e-3)


P3_CICP = (b"cICP", bytes([12, 13, 0, 1]))
GAMMA = (b"gAMA", (45455).to_bytes(4, "big"))
SRGB = (b"sRGB", b"\0")
P3_ICC = (b"iCCP", b"x\0\0" + zlib.compress(icc("P3", P3_COLUMNS, SRGB_CURVE)))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("chunks", "wide", "gamma"),
    [
        ((P3_CICP,), True, None),
        (((b"cICP", bytes([1, 13, 0, 1])), P3_ICC), False, None),
        ((P3_ICC, SRGB), True, None),
        ((SRGB, chrm(P3_CHRM)), False, None),
        ((chrm(P3_CHRM),), True, None),
        ((chrm(P3_CHRM), GAMMA), True, 2.2),
        ((chrm(P3_CHRM), (b"gAMA", (100000).to_bytes(4, "big"))), True, 1.0),
    ],
)
def test_precedence_of_png(
    tmp_path: Path, chunks: tuple[tuple[bytes, bytes], ...], wide: bool, gamma: float | None, bits: int
) -> None:
    codes = rng().integers(0, 2**bits, (4, 4, 3))
    encoded = codes / (2**bits - 1)
    linear = srgb_to_linear(encoded) if gamma is None else encoded**gamma
    expected = linear @ np.array(FROM_P3).T if wide else linear
    found = linear_rgb(read_image(png(tmp_path / "x.png", codes, 2, bits, extra=chunks)))
    assert found == pytest.approx(expected, abs=2e-3)


def test_chromaticities_of_exr_and_radiance(tmp_path: Path) -> None:
    numbers = rng().random((4, 8, 3)).astype(np.float32)
    channels = {name: numbers[..., k].copy() for k, name in enumerate("RGB")}
    path = exr(tmp_path / "x.exr", channels, chromaticities=ACESCG)
    expected = numbers @ np.array(FROM_ACESCG).T
    assert linear_rgb(read_image(path)) == pytest.approx(expected, abs=1e-4)
    assert read_image(path, "R").pixels[..., 0] == pytest.approx(numbers[..., 0])
    assert read_environment(path, 4) == pytest.approx(np.maximum(expected, 0), abs=1e-4)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nPRIMARIES=0.68 0.32 0.265 0.69 0.15 0.06 0.3127 0.329\n\n"
    (tmp_path / "x.hdr").write_bytes(head + b"-Y 2 +X 4\n" + bytes([128, 64, 32, 129]) * 8)
    assert read_environment(tmp_path / "x.hdr", 2)[0, 0] == pytest.approx(
        np.array(FROM_P3) @ (1, 0.5, 0.25), rel=0.01
    )


@pytest.mark.parametrize(("index", "adobe"), [("R03", True), ("R98", False)])
def test_cameras_declare_adobe_rgb_in_exif(tmp_path: Path, index: str, adobe: bool) -> None:
    """By its interoperability index (DCF 2.0); the matrix is that of Adobe RGB (1998) to Rec.709."""
    exif = Pillow.Exif()
    exif[0x8769] = {0xA001: 65535, 0xA005: {1: index, 2: b"0100"}}
    color = Pillow.new("RGB", (16, 16), (200, 150, 100))
    color.save(tmp_path / "c.jpg", quality=100, subsampling=0, exif=exif)
    with Pillow.open(tmp_path / "c.jpg") as stored:
        code = np.array(stored)[0, 0] / 255.0
    matrix = np.array([[1.39836, -0.39836, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04293, 1.04293]])
    expected = matrix @ code**2.19921875 if adobe else srgb_to_linear(code)
    assert linear_rgb(read_image(tmp_path / "c.jpg"))[0, 0] == pytest.approx(expected, abs=1e-4)


def test_surroundings_are_linear_and_small(tmp_path: Path) -> None:
    sky = np.zeros((200, 400, 3), np.float32)
    sky[:100] = (0.25, 0.5, 4.0)
    np.save(tmp_path / "sky.npy", sky)
    values = read_environment(tmp_path / "sky.npy", 64)
    assert values.shape == (64, 128, 3)
    np.testing.assert_allclose(values[:31], np.broadcast_to(sky[0, 0], (31, 128, 3)), rtol=1e-5)
    assert values[34:].max() == 0
    Image.fromarray(np.full((2, 4, 3), 188, np.uint8)).save(tmp_path / "gray.png")
    np.testing.assert_allclose(read_environment(tmp_path / "gray.png", 64), 0.5029, rtol=1e-3)
    # Radiance's RGBE: a mantissa of 128 and an exponent of 129 are 1.
    pixels = bytes([128, 64, 32, 129]) * 8
    (tmp_path / "one.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + pixels)
    one = read_environment(tmp_path / "one.hdr", 64)
    np.testing.assert_allclose(one[0, 0], (1, 0.5, 0.25), rtol=0.01)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
    for content, what in (
        (head + b"-Y 60000 +X 60000\n" + pixels, "claims 60000 x 60000"),
        (head + b"+X 4 +Y 2\n" + pixels, "turned"),
        (head.replace(b"rgbe", b"xyze") + b"-Y 2 +X 4\n" + pixels, "XYZ"),
        (b"#?RADIANCE\n", "Radiance picture"),
    ):
        (tmp_path / "bad.hdr").write_bytes(content)
        with pytest.raises(InputError, match=what):
            read_environment(tmp_path / "bad.hdr", 64)
