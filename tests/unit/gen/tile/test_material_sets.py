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
# Set → parts of its description, separated by semicolons.
ODDITIES = {
    "knit_fabric": "8-bit heights with 132 distinct values;holes 1.2%;--mesh 1024 keeps all",
    "leather_fine": "8-bit heights with 256 distinct values;JPG;--mesh 1024 keeps all",
    "metal_plate": "base_color constant 0.5  ",
    "rock_cliff": "8-bit heights with 115 distinct values 2.238 codes apart",
    "stone_bricks": "8-bit heights with 219 distinct values;tile 1 x 0.5;JPG",
    "tree_bark": "8-bit heights with 104 distinct values;104 distinct, codes 109 .. 237;JPG",
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
    text = material.describe(found, name)
    for part in (kind, *ODDITIES[name].split(";")):
        assert part in text, part
    assert [t["tiles"] for t in found["tiling"]] == [True, True]
    allowed = ("8-bit heights", "opacity: read", "as steep as its slopes")
    assert [w for w in found["warnings"] if not any(part in w for part in allowed)] == []
    assert any("agree at --height-scale" in w for w in found["warnings"]) == (scale < 0.033)
    normal = found["normal"]
    assert normal["convention"] == "gl"
    assert normal["fits"]
    assert normal["suggested_height_scale"] == pytest.approx(scale, rel=0.05)
    assert (normal["correlation_u"], normal["correlation_v"]) == pytest.approx(correlations, abs=0.015)


@pytest.mark.parametrize("name", ["knit_fabric", "metal_plate"])
def test_cut_maps_do_not_tile(name: str, tmp_path: Path) -> None:
    """Three quarters of 900 texels: no multiple of any cell."""
    from mbtf_core.images.read import gray, read_image

    (path,) = folder_of(name).glob("height.*")
    height = gray(read_image(path))[0]
    np.save(tmp_path / "h.npy", height[: 3 * height.shape[0] // 4 - 21, : 3 * height.shape[1] // 4 - 21])
    (warning,) = (w for w in load_material(tmp_path / "h.npy").warnings if "does not tile" in w)
    assert "along u and v" in warning
    assert not any("does not tile" in w for w in load_material(tmp_path / "h.npy", "blend").warnings)


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
