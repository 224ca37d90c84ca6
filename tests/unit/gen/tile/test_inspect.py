"""``mbtf-gen inspect``: numbers that can be checked by hand, and the material file that it writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.height_maps import fractal, normals_of, save_heights, save_normals
from support.mitsuba_shapes import tile_mesh

from mbtf_core.app.console import run
from mbtf_core.config.yaml_file import read_yaml
from mbtf_gen.cli.app import app
from mbtf_gen.config.generator import GeneratorConfig, GeometrySection
from mbtf_gen.job import Job
from mbtf_gen.tile.heights import HeightGrid, rms_slope, triangle_slopes
from mbtf_gen.tile.inspection import inspection_text
from mbtf_gen.tile.loading import load_material


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_slopes_are_those_of_the_mesh(aspect: float) -> None:
    """Against the triangles that are rendered."""
    grid = HeightGrid.from_map(fractal(int(12 * aspect), 12), 0.2, aspect)
    normals = tile_mesh(grid).face_normals
    expected = np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2]
    assert np.sort(triangle_slopes(grid)) == pytest.approx(np.sort(expected))
    assert rms_slope(grid) == pytest.approx(np.sqrt(np.mean(expected**2)))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    out = tmp_path / "rock"
    out.mkdir()
    height = fractal(48, 96)
    save_heights(out / "height.png", height)
    save_normals(out / "normal.png", normals_of(height, 0.1))
    row, column = np.mgrid[:48, :96]
    color = np.where(row < 12, 0.97, np.where(row < 18, 0.01, 0.5))[..., None] * np.ones(3)
    for name, pixels in (("albedo", color), ("opacity", column >= 24), ("metallic", column >= 50)):
        np.save(out / f"{name}.npy", pixels.astype(np.float64))
    return out


class TestNumbers:
    def test_by_hand(self, folder: Path) -> None:
        found = load_material(folder).inspect(GeometrySection(height_scale=0.2, mesh=48))
        assert (found["aspect"], found["surface"]) == (0.5, "glossy")
        assert found["geometry"]["mesh"] == [24, 48]
        assert found["geometry"]["displacement_range"] <= 0.2
        assert 0.3 < found["geometry"]["slope_kept"] < 0.95
        assert (found["albedo"]["share_above"], found["albedo"]["share_below"]) == (0.25, 0.125)
        assert (found["albedo"]["min"], found["albedo"]["max"]) == pytest.approx((0.01, 0.97))
        assert found["opacity"] == {"holes": 0.25, "partly": 0.0}
        assert found["normal"]["suggested_height_scale"] == pytest.approx(0.1, rel=0.01)
        assert [t["tiles"] for t in found["tiling"]] == [True, True]

    @pytest.mark.parametrize("shape", [(1, 1), (1, 9), (5, 1), (2, 3)])
    def test_tiny_maps(self, tmp_path: Path, shape: tuple[int, int]) -> None:
        save_heights(tmp_path / "height.png", np.random.default_rng(0).random(shape), 8)
        save_normals(tmp_path / "normal.png", np.full((*shape, 3), (0.0, 0.0, 1.0)))
        found = load_material(tmp_path).inspect(GeometrySection())
        assert found["maps"]["height"]["columns"] == shape[1]
        assert found["normal"] is not None
        assert f"columns {shape[1]}" in " ".join(inspection_text(found, "tiny").split())


# Height scale of the normal map, and the one that it suggests: 8-bit normals of gentle slopes are rounded.
SCALE = 0.0123
STORED = 0.012


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """Maps that do not tile, with a DirectX normal map: three quarters of a periodic tile."""
    out = tmp_path / "maps"
    out.mkdir()
    height = fractal(128, 128)
    save_heights(out / "height.png", height[:96, :96])
    # The cut tile is three quarters as wide: heights in its widths are 4/3 as high.
    save_normals(out / "normal.png", normals_of(height, 0.75 * SCALE)[:96, :96], dx=True)
    np.save(out / "color.npy", np.full((96, 96, 3), 120, np.uint8))
    return out


def job_of(material: Path, **sections: Any) -> Job:
    return Job.load(GeneratorConfig.model_validate({"material": str(material), **sections}))


def written(folder: Path, *flags: str, file: str = "material.yaml") -> dict[str, Any]:
    assert run(app, ["inspect", str(folder), "--write", str(folder / file), *flags]) == 0
    return dict(read_yaml(folder / file))


class TestWrite:
    def test_what_the_material_file_says(self, maps: Path) -> None:
        text = "height: {file: height.png, scale: 0.2}\nmake_tileable: none\nresolution: 8\nroughness: 0.4\n"
        (maps / "material.yaml").write_text(text)
        content = written(maps, "--overwrite")
        assert content == {
            "height": {"file": "height.png", "scale": 0.2},
            "roughness": {"value": 0.4},
            "make_tileable": "none",
            "resolution": 8,
        }

    def test_the_other_commands_need_no_flags(self, maps: Path) -> None:
        geometry = {"height_scale": STORED, "make_tileable": "blend"}
        flagged = job_of(maps, geometry=geometry, queries={"resolution": 16})
        written(maps, "--resolution", "16")
        plain = job_of(maps)
        assert np.array_equal(plain.material.grid.z, flagged.material.grid.z)
        for role in ("base_color", "normal"):
            assert np.array_equal(plain.material.maps[role], flagged.material.maps[role])
        assert plain.lattice == flagged.lattice
        assert plain.config.geometry == flagged.config.geometry
        assert plain.config.queries == flagged.config.queries
