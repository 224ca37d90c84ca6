"""Real texture sets, as they come: loaded without configuration; every oddity is named."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.paths import SHARED

from mbtf_gen.config.generator import GeometrySection
from mbtf_gen.tile.loading import load_material

MATERIALS = SHARED / "data/materials"

# Set → (kind of heights, height that the normal map suggests, correlations u, v).
SETS: dict[str, tuple[str, float, tuple[float, float]]] = {
    "knit_fabric": ("8-bit RGBA", 0.0101, (0.89, 0.92)),
    "leather_fine": ("8-bit gray", 0.0009, (0.93, 0.93)),
    "metal_plate": ("16-bit gray", 0.0087, (0.94, 0.96)),
    "rock_cliff": ("8-bit gray", 0.0333, (0.89, 0.90)),
    "stone_bricks": ("8-bit gray", 0.0088, (0.92, 0.90)),
    "tree_bark": ("8-bit gray", 0.0111, (0.83, 0.77)),
}


def folder_of(name: str) -> Path:
    if not (MATERIALS / name).is_dir():
        pytest.skip(f"{name} is not beside the project")
    return MATERIALS / name


def inspected(folder: Path) -> dict[str, Any]:
    return load_material(folder).inspect(GeometrySection())


@pytest.mark.parametrize("name", SETS)
def test_every_oddity_is_named_and_nothing_else(name: str) -> None:
    """All six tile, and their normal maps fit; the default height is far off for those of gentle slopes."""
    material = load_material(folder_of(name))
    found = material.inspect(GeometrySection())
    kind, scale, correlations = SETS[name]
    assert kind in material.describe(found, name)
    assert [t["tiles"] for t in found["tiling"]] == [True, True]
    allowed = ("8-bit heights", "opacity: read", "as steep as its slopes")
    assert [w for w in found["warnings"] if not any(part in w for part in allowed)] == []
    assert any("add --height-scale" in w for w in found["warnings"]) == (scale < 0.033)
    normal = found["normal"]
    assert normal["convention"] == "gl"
    assert normal["fits"]
    assert normal["suggested_height_scale"] == pytest.approx(scale, rel=0.05)
    assert (normal["correlation_u"], normal["correlation_v"]) == pytest.approx(correlations, abs=0.015)


def test_the_published_rotation_of_metal_plate_is_found(tmp_path: Path) -> None:
    """The set was published with its heights turned by 90 degrees against all other maps."""
    from PIL import Image as Pillow

    out = tmp_path / "metal_plate"
    shutil.copytree(folder_of("metal_plate"), out, copy_function=shutil.copyfile)
    stored = np.asarray(Pillow.open(out / "height.png")).astype(np.uint16)
    out.chmod(0o755)
    (out / "height.png").unlink()
    Pillow.fromarray(np.ascontiguousarray(np.rot90(stored, -1))).save(out / "height.png")
    found = inspected(out)
    (warning,) = (w for w in found["warnings"] if "fits" in w)
    assert "height.png: fits normal.jpg only when turned by 90 degrees counter-clockwise" in warning
    assert found["normal"]["best"] > 0.9
    assert abs(found["normal"]["gl"]) < 0.1
    assert "DOES NOT FIT" in load_material(out).describe(found, "metal_plate")
