"""The material that is kept between two calls is that of the files as they are."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.errors import InputError
from mbtf_gen.tile.loading import latest_material


def write_png(path: Path, codes: NDArray[np.uint8]) -> None:
    Image.fromarray(codes).save(path)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_png(tmp_path / "height.png", np.arange(64, dtype=np.uint8).reshape(8, 8))
    write_png(tmp_path / "roughness.png", np.full((8, 8), 90, np.uint8))
    return tmp_path


def test_an_unchanged_material_is_not_decoded_again(folder: Path) -> None:
    first = latest_material(folder)
    assert latest_material(folder) is first
    # A job states the method that it found.
    assert latest_material(folder, "none") is first
    assert latest_material(folder, "mirror") is not first


def test_a_changed_folder_is_loaded_again(folder: Path) -> None:
    first = latest_material(folder)
    # As many bytes, and the same times, as before.
    path = folder / "roughness.png"
    stat = path.stat()
    write_png(path, np.full((8, 8), 200, np.uint8))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    second = latest_material(folder)
    before, after = (np.asarray(m.maps["roughness"], np.float64).mean() for m in (first, second))
    assert after > before
    write_png(folder / "metallic.png", np.full((8, 8), 255, np.uint8))
    assert np.mean(latest_material(folder).maps["metallic"]) == 1.0 != np.mean(second.maps["metallic"])
    (folder / "material.yaml").write_text("height: {file: height.png, scale: 0.3}\n", encoding="utf-8")
    assert latest_material(folder).height_scale == 0.3
    (folder / "height.png").unlink()
    with pytest.raises(InputError):
        latest_material(folder)
