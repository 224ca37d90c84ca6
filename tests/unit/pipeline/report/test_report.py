"""Images, error maps, times and materials of the report."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mbtf_core.color import palette, robust_scale
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.loading import load_material
from mbtf_pipeline.report.images import data_uri, map_uri, scaled_maps
from mbtf_pipeline.report.sections import material_section


def decoded(uri: str) -> np.ndarray:
    head, _, data = uri.partition(",")
    assert head in ("data:image/png;base64", "data:image/jpeg;base64")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def test_images_match_their_sources() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (96, 128, 3), np.uint8)
    assert (decoded(data_uri(picture)) == picture).all()
    values = np.tile(np.linspace(0, 1, 128), (96, 1))
    assert (decoded(map_uri(values, "local"))[0, [0, -1]] == palette("local")[[0, -1]]).all()
    assert decoded(map_uri(2 * values - 1, "signed"))[0, 64].max() < 40


def test_a_diverged_fit_is_clipped_and_marked() -> None:
    """It does not widen the scale of the others; fits that differ by less keep one scale."""
    ramp = np.linspace(0, 0.1, 400).reshape(20, 20)
    assert robust_scale([[ramp], [2 * ramp]]) == robust_scale([[2 * ramp]])
    fits = {"good": {"g": ramp}, "fair": {"f": 2 * ramp}, "diverged": {"d": 1e4 * ramp}}
    bars, images, beyond = scaled_maps({"local": fits, "signed": {"good": {"g": ramp}}})
    assert bars["local"]["ticks"] == ["0", "5", "10", "15", "≥ 20"]
    assert not any("≥" in tick for tick in bars["signed"]["ticks"])
    assert list(beyond) == ["d-local"]
    assert beyond["d-local"] == pytest.approx(1, abs=0.01)
    assert (decoded(images["f-local"])[-1, -1] == palette("local")[-1]).all()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Maps whose right half is the brighter or redder one; the heights do not tile and have 8 bits."""
    ramp = np.tile(np.arange(256, dtype=np.uint8), (300, 1))
    Image.fromarray(ramp).save(tmp_path / "height.png")
    red = np.zeros((300, 256, 3), np.uint8)
    red[:, 128:, 0] = 200
    Image.fromarray(red).save(tmp_path / "base_color.png")
    return tmp_path


def test_maps_and_warnings_are_shown(folder: Path) -> None:
    found = material_section(GeneratorConfig(material=str(folder)), load_material(folder).digests)
    assert found["missing"] == ""
    maps = {m["label"]: m for m in found["maps"]}
    assert set(maps) == {"Height", "Base color"}
    for shown, brightest in (maps["Height"], 255), (maps["Base color"], 200):
        pixels = decoded(shown["image"]).astype(int)
        assert pixels.shape == (150, 128, 3)
        assert pixels[:, :10, 0].max() < 24
        assert abs(pixels[:, -10:, 0].max() - brightest) < 8
    warnings = "\n".join(found["warnings"])
    assert "height.png: 8-bit heights" in warnings
    assert "height.png: does not tile along u" in warnings


def test_a_material_that_changed_since_is_not_shown(folder: Path) -> None:
    digests = load_material(folder).digests
    config = GeneratorConfig(material=str(folder))
    Image.new("L", (256, 300), 7).save(folder / "height.png")
    changed = material_section(config, digests)
    (folder / "height.png").unlink()
    gone = material_section(config, digests)
    assert "has changed" in changed["missing"]
    assert "cannot be read any more" in gone["missing"]
    assert changed["maps"] == gone["maps"] == []
