"""``mbtf-gen inspect``: numbers that can be checked by hand, and their text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.height_maps import fractal, normals_of, save_heights, save_normals

from mbtf_gen.config.generator import GeometrySection
from mbtf_gen.tile.heights import HeightGrid, rms_slope, slope_angles, triangle_slopes
from mbtf_gen.tile.inspection import inspection_text
from mbtf_gen.tile.loading import load_material


class TestSlopes:
    @pytest.mark.parametrize("aspect", [1.0, 0.5])
    def test_slopes_are_those_of_the_mesh(self, aspect: float) -> None:
        """Against the triangles that are rendered."""
        from mbtf_gen.tile.heights import tile_mesh

        grid = HeightGrid.from_map(fractal(int(12 * aspect), 12), 0.2, aspect)
        normals = tile_mesh(grid).face_normals
        expected = np.hypot(normals[:, 0], normals[:, 1]) / normals[:, 2]
        assert np.sort(triangle_slopes(grid)) == pytest.approx(np.sort(expected))
        assert rms_slope(grid) == pytest.approx(np.sqrt(np.mean(expected**2)))

    def test_percentiles(self) -> None:
        """A gentle flank over seven eighths of the tile, a steep one over the last."""
        gentle = np.arange(57) / 56 * 0.1
        steep = 0.1 - np.arange(1, 8) / 8 * 0.1
        saw = np.tile(np.concatenate([gentle, steep]), (4, 1))
        median, high, steepest = slope_angles(HeightGrid.from_map(saw, 1.0, 1 / 16))
        expected = np.degrees(np.arctan([0.1 * 64 / 56, 0.1 * 8, 0.1 * 8]))
        assert (median, high, steepest) == pytest.approx(tuple(expected))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    out = tmp_path / "rock"
    out.mkdir()
    height = fractal(48, 96)
    save_heights(out / "height.png", height)
    save_normals(out / "normal.png", normals_of(height, 0.1))
    color = np.full((48, 96, 3), 0.5)
    color[:12] = 0.97
    color[12:18] = 0.01
    np.save(out / "albedo.npy", color)
    opacity = np.ones((48, 96))
    opacity[:, :24] = 0.0
    np.save(out / "opacity.npy", opacity)
    metallic = np.zeros((48, 96))
    metallic[:, 50:] = 1.0
    np.save(out / "metallic.npy", metallic)
    return out


def test_the_warning_about_the_scale_states_the_slopes_that_it_leads_to(folder: Path) -> None:
    material = load_material(folder)
    assert material.normal_fit is not None
    agreed = slope_angles(material.at(material.normal_fit.scale).grid)[0]
    for scale in (0.01, 0.6, -0.6):
        other = material.at(scale)
        now = slope_angles(other.grid)[0]
        assert re.findall(r"[\d.]+°", other.scale_warning() or "") == [f"{agreed:.1f}°", f"{now:.1f}°"]


class TestNumbers:
    def test_by_hand(self, folder: Path) -> None:
        found = load_material(folder).inspect(GeometrySection(height_scale=0.2, mesh=48))
        assert found["aspect"] == 0.5
        assert found["surface"] == "glossy"
        assert found["geometry"]["mesh"] == [24, 48]
        assert found["geometry"]["height_scale"] == 0.2
        assert found["geometry"]["displacement_range"] <= 0.2
        assert 0.3 < found["geometry"]["slope_kept"] < 0.95
        assert found["albedo"]["share_above"] == 0.25
        assert found["albedo"]["share_below"] == 0.125
        assert found["albedo"]["median"] == pytest.approx(0.5)
        assert (found["albedo"]["min"], found["albedo"]["max"]) == pytest.approx((0.01, 0.97))
        assert found["opacity"] == {"holes": 0.25, "partly": 0.0}
        assert found["normal"]["suggested_height_scale"] == pytest.approx(0.1, rel=0.01)
        assert found["constants"] == {"roughness": 0.5, "specular": 0.5}
        assert [t["tiles"] for t in found["tiling"]] == [True, True]
        texts = "\n".join(found["oddities"])
        for part in ("the mesh keeps", "--mesh 96 keeps all", "25.0% of the albedo lies above 0.95"):
            assert part in texts

    @pytest.mark.parametrize("shape", [(1, 1), (1, 9), (5, 1), (2, 3)])
    def test_tiny_maps(self, tmp_path: Path, shape: tuple[int, int]) -> None:
        save_heights(tmp_path / "height.png", np.random.default_rng(0).random(shape), 8)
        save_normals(tmp_path / "normal.png", np.full((*shape, 3), (0.0, 0.0, 1.0)))
        found = load_material(tmp_path).inspect(GeometrySection())
        assert found["maps"]["height"]["columns"] == shape[1]
        assert found["normal"] is not None
        assert "nothing to compare" in inspection_text(found, "tiny")
