"""``mbtf-gen inspect --write``: a material file after which no command needs the flags; ``--export``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.height_maps import fractal, normals_of, save_heights, save_normals

from mbtf_core.app.console import run
from mbtf_core.config.yaml_file import read_yaml
from mbtf_gen.cli.app import app
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_gen.tile.loading import load_material

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
    def test_what_the_maps_show(self, maps: Path) -> None:
        assert written(maps) == {
            "height": {"file": "height.png", "scale": STORED},
            "base_color": {"file": "color.npy", "colorspace": "srgb"},
            "normal": {"file": "normal.png", "convention": "dx"},
            "make_tileable": "blend",
        }

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


class TestExport:
    @pytest.mark.parametrize("flags", [(), ("--mesh", "40"), ("--height-scale", "-0.2")])
    def test_read_back_it_is_the_same_grid(self, tmp_path: Path, flags: tuple[str, ...]) -> None:
        """8-bit heights, dequantized and resampled."""
        save_heights(tmp_path / "height.png", fractal(48, 96), 8)
        out = tmp_path / "out" / "heights.exr"
        assert run(app, ["inspect", str(tmp_path), "--export", str(out), *flags]) == 0
        mesh = int(flags[1]) if flags[:1] == ("--mesh",) else None
        scale = float(flags[1]) if flags[:1] == ("--height-scale",) else None
        expected, found = load_material(tmp_path).at(scale, mesh).grid, load_material(out).grid
        assert np.array_equal(found.z, expected.z.astype(np.float32))
        assert found.z.max() == 0.0
        assert found.aspect == expected.aspect
