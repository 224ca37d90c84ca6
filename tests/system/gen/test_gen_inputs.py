"""A texture set as sites hand them out, from ``inspect`` to a finished data set."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from support.commands import run_all
from support.height_maps import fractal, normals_of, save_heights, save_normals
from support.image_files import png, rng


def test_a_set_of_unequal_maps_that_do_not_tile(tmp_path: Path) -> None:
    """Not square, no powers of two, three resolutions, a DirectX normal map without a name for it, a seam."""
    folder = tmp_path / "Brick_07"
    folder.mkdir()
    height, normals = fractal(60, 100), normals_of(fractal(60, 100), 0.05)
    save_heights(folder / "Brick_07_Displacement.png", height[:36, :72])
    save_normals(folder / "Brick_07_Normal.png", normals[:36, :72], dx=True)
    png(folder / "Brick_07_Color.png", rng().integers(40, 200, (18, 36, 3)), 2, 8)
    png(folder / "Brick_07_Roughness.png", rng().integers(9000, 60000, (54, 108, 1)), 0, 16, interlace=True)
    options = ["--queries", 200, "--test-queries", 50, "--test-spp", 4, "--resolution", 8]
    looked, plain, mirrored, planned = run_all(
        [
            ["inspect", folder, "--json", "--quiet"],
            [folder, "-o", "plain", *options],
            [folder, "-o", "mirrored", "--make-tileable", "mirror", *options],
            ["plan", folder, "--make-tileable", "mirror", "--no-measure", "--set", "queries.train=200"],
        ],
        tmp_path,
    )
    done = (looked, plain, mirrored, planned)
    assert [d.code for d in done] == [0, 0, 0, 0], [d.err for d in done]
    found = json.loads(looked.out)
    assert found["normal"]["convention"] == "dx"
    assert [t["tiles"] for t in found["tiling"]] == [False, False]
    assert "does not tile along u and v" in plain.err
    assert "does not tile" not in mirrored.err
    assert "does not tile" not in planned.err
    for name, shape in (("plain", [36, 72]), ("mirrored", [72, 144])):
        manifest = json.loads((tmp_path / name / "manifest.json").read_text())
        assert manifest["complete"]
        assert manifest["tile"]["aspect"] == 0.5
        assert manifest["tile"]["maps_shape"] == shape
        assert manifest["levels"]["shape"] == [4, 8]
        values = np.load(tmp_path / name / "train-00000.npz")["value_a"]
        assert np.isfinite(values).all()
        assert 0 < values.mean() < 1
