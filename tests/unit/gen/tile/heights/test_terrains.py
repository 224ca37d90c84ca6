"""Terrains: missing data, heights in meters, and files that state the size of their pixels."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from support.image_files import rng

from mbtf_core.errors import InputError
from mbtf_gen.config.generator import GeometrySection
from mbtf_gen.tile.loading import load_material

DEFAULT = GeometrySection()


def hills(rows: int = 32, columns: int = 48) -> np.ndarray:
    x = 2 * np.pi * np.arange(columns) / columns
    return np.broadcast_to(600 + 20 * np.sin(x), (rows, columns)).copy()


def terrain(path: Path, heights: Any, *tags: tuple[int, int, Any]) -> Path:
    """A TIFF with extra tags: (code, type, value)."""
    extra = [(code, kind, 0 if kind == 2 else len(value), value, True) for code, kind, value in tags]
    tifffile.imwrite(path, heights, extratags=extra)
    return path


@pytest.mark.parametrize(
    ("dtype", "nodata", "tag"),
    [
        ("f4", -9999, None),
        ("f4", -3.4028234663852886e38, "-3.40282346638529e+38"),
        ("f4", 555, "555"),
        ("i2", -32768, None),
        ("u2", 0, "0"),
    ],
)
def test_missing_data_are_refused(tmp_path: Path, dtype: str, nodata: float, tag: str | None) -> None:
    heights = hills().astype(dtype)
    heights[3, 5:7] = nodata
    tags = [] if tag is None else [(42113, 2, tag)]
    path = terrain(tmp_path / "dem.tif", heights, *tags)
    (tmp_path / "m.yaml").write_text("height: {file: dem.tif, scale: 0.0001}\n")
    for given in (path, tmp_path / "m.yaml"):
        with pytest.raises(InputError, match="2 pixels, the first at column 5, row 3,") as caught:
            load_material(given)
        assert "fill" in caught.value.hint


def test_low_heights_and_unused_declarations_are_data(tmp_path: Path) -> None:
    deep = np.linspace(-9999, 4000, 32 * 48).reshape(32, 48)
    assert load_material(terrain(tmp_path / "sea.tif", deep.astype("i2"))).height.min() == -9999
    # Codes of 8 bits are never -9999, whatever that would be modulo 256.
    codes = np.full((32, 48), -9999 % 256, np.uint8)
    found = load_material(terrain(tmp_path / "byte.tif", codes, (42113, 2, "-9999")))
    assert found.facts["height"].bits == 8


def test_heights_in_meters_need_a_scale(tmp_path: Path) -> None:
    np.save(tmp_path / "dem.npy", hills())
    material = load_material(tmp_path / "dem.npy")
    with pytest.raises(InputError, match=r"580 to 620 need a height scale") as caught:
        _ = material.configured(DEFAULT).grid
    assert f"{1 / 48:.4g}" in caught.value.hint
    assert any("generation refuses it" in w for w in material.inspect(DEFAULT)["warnings"])
    # Given, even as the default, it is what is meant.
    for scale in (1 / 48, 1.0):
        given = material.configured(GeometrySection(height_scale=scale))
        assert given.grid.displacement_range == pytest.approx(40 * scale, rel=1e-3)
    (tmp_path / "m.yaml").write_text(f"height: {{file: dem.npy, scale: {1 / 48}}}\n")
    assert load_material(tmp_path / "m.yaml").configured(DEFAULT).grid is not None


SCALE, TIE, MATRIX, KEYS = 33550, 33922, 34264, 34735
DEGREES = (KEYS, 3, (1, 1, 0, 1, 1024, 0, 1, 2))


@pytest.mark.parametrize(
    ("dtype", "tags", "scale"),
    [
        ("f4", [(SCALE, 12, (30.0, 30.0, 0.0))], 1 / (48 * 30)),
        # As codes, the unit is 1/65535.
        ("u2", [(SCALE, 12, (30.0, 30.0, 0.0))], 65535 / (48 * 30)),
        ("i2", [(MATRIX, 12, (3.0, 8.0, 0, 0, -4.0, 6.0, *[0.0] * 10))], 1 / (48 * 5)),
        (
            "i2",
            [(SCALE, 12, (1 / 3600, 1 / 3600, 0.0)), (TIE, 12, (0, 0, 0, 7.0, 60.0, 0)), DEGREES],
            3600 / (48 * 111320 * math.cos(math.radians(60))),
        ),
    ],
)
def test_the_size_of_pixels_gives_the_scale(tmp_path: Path, dtype: str, tags: Any, scale: float) -> None:
    material = load_material(terrain(tmp_path / "dem.tif", hills().astype(dtype), *tags))
    with pytest.raises(InputError, match="need a height scale") as caught:
        _ = material.configured(DEFAULT).grid
    suggested = float(caught.value.hint.split("--height-scale ")[1].split(",")[0])
    # The matrix of pixels turned by 53°, not square, has columns 5 apart.
    assert suggested == pytest.approx(scale, rel=1e-3)


def test_fractions_that_are_cliffs_need_a_scale(tmp_path: Path) -> None:
    for factor, refused in ((1.0, True), (0.45, False)):
        np.save(tmp_path / "noise.npy", factor * rng().random((64, 64)))
        material = load_material(tmp_path / "noise.npy")
        # Differences of neighbors are 1/3 on average, at 64 per tile width: over 80° but for 0.27.
        assert (material.unit_fault() is not None) == refused
        assert material.at(height_scale=1.0).unit_fault() is None
    np.save(tmp_path / "noise.npy", rng().random((64, 64)))
    with pytest.raises(InputError, match="steeper than 8") as caught:
        _ = load_material(tmp_path / "noise.npy").configured(DEFAULT).grid
    assert "--height-scale 0.05" in caught.value.hint


def test_fractions_that_a_normal_map_contradicts_need_its_scale(tmp_path: Path) -> None:
    """Bumps with a median slope of 83°, and the normals of bumps 54 times as low."""
    phase = 2 * np.pi * 5 * (np.arange(128) + 0.5) / 128
    heights = 0.25 * (np.sin(phase)[:, None] + np.sin(phase)) + 0.5
    np.save(tmp_path / "height.npy", heights)
    for times, refused in ((54.0, True), (1.0, False)):
        slope = 0.25 * 2 * np.pi * 5 * np.cos(phase) / times
        normal = np.stack(np.broadcast_arrays(-slope, slope[:, None], 1.0), axis=-1)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        np.save(tmp_path / "normal.npy", (normal + 1) / 2)
        fault = load_material(tmp_path).unit_fault()
        assert (fault is not None) == refused
        if fault is not None:
            suggested = float(fault[1].split("--height-scale ")[1].split(";")[0])
            assert suggested == pytest.approx(1 / times, rel=0.1)
