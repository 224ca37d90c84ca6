"""The material of the report: a thumbnail of each map, and the warnings of ``mbtf-gen inspect``."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.tile.loading import load_material
from mbtf_pipeline.report.sections import material_section


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
        data = base64.b64decode(shown["image"].partition("base64,")[2])
        pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
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
