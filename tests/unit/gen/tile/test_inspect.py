"""``mbtf-gen inspect``: numbers that can be checked by hand, and the material file that it writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.height_maps import fractal, normals_of, save_heights, save_normals
from support.mitsuba_shapes import tile_mesh

from mbtf_gen.config.generator import GeometrySection
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
