"""Whole runs on a mesh of two parts: data, pictures, description."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from support.commands import run_named

from mbtf_core.data.dataset import Dataset

LINES = {
    "generate": "pebbles.glb --resolution 16 --queries 40/texel --test-queries 256 -o data --json",
    "verify": "verify data",
    "reference": "reference pebbles.glb --view 50,20 --tiles-across 1 --size 24 --spp 8 -o reference",
    "preview": "preview pebbles.glb -o preview --size 64 --spp 4 --set queries.train=3000",
}


def write_pebbles(path: Path) -> None:
    """Red pebbles on a gray floor, in centimeters; one reaches over the border."""
    pebbles = []
    for place in ((0.0, 1.2, 0.3), (1.5, 0.6, 0.35), (2.4, 1.9, 0.38)):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
        ball.apply_scale([1.0, 0.8, 0.5])
        pebbles.append(ball.apply_translation(place))
    floor = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [3, 2.4, 0], [0, 2.4, 0]], [[0, 1, 2], [0, 2, 3]])
    scene = trimesh.Scene()
    for mesh, color in ((trimesh.util.concatenate(pebbles), [200, 40, 30, 255]), (floor, [128] * 3 + [255])):
        # glTF has y up.
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=color, metallicFactor=0.0)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(mesh)
    scene.export(path)


def test_a_mesh_gives_data_and_pictures(tmp_path: Path) -> None:
    write_pebbles(tmp_path / "pebbles.glb")
    done = run_named(LINES, tmp_path)
    assert done["generate"].result()["complete"]
    for name in ("verify", "reference", "preview"):
        assert done[name].code == 0, done[name].err
    dataset = Dataset.open(tmp_path / "data")
    # A pebble over the border makes the mesh wider than its floor.
    assert dataset.manifest["tile"]["triangles"] == 3 * 320 + 2
    assert dataset.geometry() is None
    test = dataset.load("test")
    value = 0.5 * (test["value_a"] + test["value_b"])
    assert (value.mean(axis=0)[0] > 1.2 * value.mean(axis=0)[1:]).all()
    with Image.open(tmp_path / "preview/beauty.png") as picture:
        assert np.asarray(picture).std() > 5
