"""Shapes with tiles: conformal charts, displacement, and their pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbtf_core.app.console import Console
from mbtf_core.data.shard_files import read_exr
from mbtf_core.errors import InputError, UsageError
from mbtf_core.pictures import read_references, read_value
from mbtf_gen.config.pictures import ReferenceConfig, Shape
from mbtf_gen.pictures.reference import render_references
from mbtf_gen.pictures.shapes import Chart
from mbtf_gen.tile.heights import HeightGrid

SHAPES = ("sphere", "cylinder", "torus")


@pytest.mark.parametrize("shape", SHAPES)
def test_tiles_are_square_and_face_outwards(shape: Shape) -> None:
    chart = Chart(shape, 13, 0.5)
    low, high = chart.along
    x, y = np.random.default_rng(0).uniform(
        [[0.0], [0.6 * low + 0.4 * high]], [[13.0], [high * 0.7]], (2, 50)
    )
    step = 1e-5
    p, n, width = chart.at(x, y)
    along_x, along_y = (
        (chart.at(x + dx, y + dy)[0] - chart.at(x - dx, y - dy)[0]) / (2 * step)
        for dx, dy in ((step, 0.0), (0.0, step))
    )
    for along in (along_x, along_y):
        np.testing.assert_allclose(np.linalg.norm(along, axis=1), width, rtol=1e-6)
    np.testing.assert_allclose(np.cross(along_x, along_y), n * width[:, None] ** 2, atol=1e-6)
    assert np.hypot(p[:, 0], p[:, 1]).max() <= chart.radius + 1e-9


@pytest.mark.parametrize("shape", ["sphere", "torus"])
def test_shapes_are_closed(shape: Shape) -> None:
    chart = Chart(shape, 13, 1.0)
    low, high = chart.along
    x = np.linspace(0, 13, 27)
    ends = [chart.at(x, np.full_like(x, y))[0] for y in (low, high)]
    if shape == "sphere":
        assert [float(np.ptp(end, axis=0).max()) for end in ends] == pytest.approx([0.0, 0.0], abs=1e-9)
    else:
        np.testing.assert_allclose(*ends, atol=1e-9)
        assert high == round(high)
    np.testing.assert_allclose(ends[0][0], ends[0][-1], atol=1e-9)


def test_too_many_triangles_are_refused_with_a_mesh_that_fits() -> None:
    grid = HeightGrid(np.zeros((512, 512)), 1.0)
    with pytest.raises(InputError, match="cells") as caught:
        Chart("sphere", 13, 1.0).mesh(grid, None)
    cells = int(str(caught.value.hint).split()[2].strip(","))
    low, high = Chart("sphere", 13, 1.0).along
    assert 0.9 * 2**24 < 13 * (high - low) * cells**2 <= 2**24


def test_a_picture_of_a_shape(tmp_path: Path) -> None:
    """A Lambert sphere that the camera's light illuminates."""
    np.save(tmp_path / "heights.npy", np.zeros((4, 4), np.float32))
    (tmp_path / "flat.yaml").write_text("height: heights.npy\nbase_color: [1.0, 1.0, 1.0]\n")
    config = ReferenceConfig.model_validate(
        {
            "material": str(tmp_path / "flat.yaml"),
            "reference": {
                "surface": "sphere",
                "tiles": 25,
                "tiles_across": [10.0],
                "size": 48,
                "spp": 16,
                "view": "30,20",
                "light": "30,20",
            },
        }
    )
    folder = tmp_path / "pictures"
    render_references(config, folder, Console(quiet=True))
    value = read_value(folder / "sphere-tiles10.exr")
    # Rays of the camera, of 20°, through a fine grid.
    distance, radius = 5.0 / np.tan(np.radians(10.0)), 25 / (2 * np.pi)
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 1001) * np.tan(np.radians(10.0))])
    forward = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    square = radius**2 - distance**2 * (1.0 - forward**2)
    t = distance * forward - np.sqrt(np.maximum(square, 0.0))
    cosine = np.where(square > 0, (distance - t * forward) / radius, 0.0)
    seen = (square > 0).mean()
    covered = 1.0 - read_exr(folder / "sphere-tiles10.exr", ("transmittance",))["transmittance"]
    assert float(covered.mean()) == pytest.approx(seen, rel=0.01)
    assert float(value.mean()) == pytest.approx(cosine.mean() / np.pi, rel=0.01)
    assert (folder / "sphere-tiles10.png").is_file()
    with pytest.raises(InputError, match="not the plane"):
        read_references(folder)


def test_a_shape_is_seen_from_outside(tmp_path: Path) -> None:
    """Whole by default; a picture without light has no noise."""
    np.save(tmp_path / "heights.npy", np.zeros((4, 4), np.float32))
    options = {"surface": "sphere", "tiles": 25, "size": 16, "spp": 2, "view": "30,20", "light": "30,200"}
    data = {"material": str(tmp_path / "heights.npy"), "reference": options}
    config = ReferenceConfig.model_validate(data)
    render_references(config, tmp_path / "whole", Console(quiet=True))
    seen = read_exr(tmp_path / "whole" / "sphere-tiles10.exr", ("transmittance",))["transmittance"][0]
    border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
    assert seen.mean() < 0.6
    assert border.min() > 0.9
    near = config.model_copy(
        update={"reference": config.reference.model_copy(update={"tiles_across": [9, 1]})}
    )
    with pytest.raises(UsageError, match="inside the sphere") as caught:
        render_references(near, tmp_path / "near", Console(quiet=True))
    assert str(caught.value.hint).endswith("1.5")
