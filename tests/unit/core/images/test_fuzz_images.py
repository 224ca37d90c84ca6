"""Damaged images of every format: they load, or are refused in a line or two; no other exception."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fuzzing import damaged, examples, loads_or_refuses, with_checksums
from support.image_samples import bmps, exrs, jpgs, npys, pngs, tgas, tiffs

from mbtf_core.images.read import read_image


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Room for one damaged file at a time."""
    return tmp_path_factory.mktemp("images")


@pytest.fixture(scope="module")
def samples(folder: Path) -> dict[str, dict[str, bytes]]:
    """Suffix → name → content."""
    out = {"png": pngs(), "jpg": jpgs(), "tif": tiffs(), "npy": npys(), "exr": exrs(folder)}
    return {**out, "tga": tgas(), "bmp": bmps()}


def read(folder: Path, name: str, content: bytes) -> None:
    """Read a file of that content."""
    path = folder / f"damaged{Path(name).suffix}"
    path.write_bytes(content)
    image = loads_or_refuses(lambda: read_image(path))
    if image is not None:
        assert image.pixels.ndim == 3
        assert 1 <= image.pixels.shape[2] <= 4
        assert np.isfinite(image.pixels).all()


@pytest.mark.parametrize("kind", ["png", "jpg", "tif", "npy", "exr", "tga", "bmp"])
@given(data=st.data())
@examples(200)
def test_a_damaged_image(
    kind: str, data: st.DataObject, samples: dict[str, dict[str, bytes]], folder: Path
) -> None:
    name, content = data.draw(damaged(samples[kind]))
    if kind == "png" and data.draw(st.booleans()):
        content = with_checksums(content)
    read(folder, name, content)


@pytest.mark.parametrize("kind", ["png", "jpg", "tif", "exr", "tga", "bmp"])
def test_decoders_say_nothing(
    kind: str, samples: dict[str, dict[str, bytes]], folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, content in samples[kind].items():
        for share in (0.3, 0.6, 0.9):
            at = int(share * len(content))
            read(folder, name, content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :])
    assert capfd.readouterr() == ("", "")
