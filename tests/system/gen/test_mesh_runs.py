"""Whole runs on a mesh of two parts: data, pictures, description."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import Done, run_named

from mbtf_core.data.dataset import Dataset

LINES = {
    "generate": "pebbles.glb --resolution 16 --queries 40/texel --test-queries 256 -o data --json",
    "verify": "verify data",
    "reference": "reference pebbles.glb --view 50,20 --tiles-across 1 --size 24 --spp 8 -o reference",
    "preview": "preview pebbles.glb -o preview --size 64 --spp 4 --set queries.train=3000",
}


def write_pebbles(path: Path) -> None:
    """Glossy red pebbles on a gray floor, in centimeters; one reaches over the border."""
    rng = np.random.default_rng(0)
    scene = trimesh.Scene()
    pebbles = []
    for x, y in ((0.0, 1.2), (1.5, 0.6), (2.4, 1.9)):
        ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
        ball.apply_scale([1.0, 0.8, 0.5])
        ball.apply_translation([x, y, 0.3 + 0.1 * rng.random()])
        pebbles.append(ball)
    floor = trimesh.Trimesh([[0, 0, 0], [3, 0, 0], [3, 2.4, 0], [0, 2.4, 0]], [[0, 1, 2], [0, 2, 3]])
    for name, mesh, color, roughness in (
        ("pebbles", trimesh.util.concatenate(pebbles), [200, 40, 30, 255], 0.3),
        ("floor", floor, [128, 128, 128, 255], 1.0),
    ):
        # glTF has y up.
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=color, roughnessFactor=roughness, metallicFactor=0.0
            )
        )
        scene.add_geometry(mesh, geom_name=name)
    scene.export(path)


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mesh")
    write_pebbles(folder / "pebbles.glb")
    return folder


@pytest.fixture(scope="module")
def done(work: Path) -> dict[str, Done]:
    return run_named(LINES, work)


def test_a_mesh_gives_a_complete_data_set(work: Path, done: dict[str, Done]) -> None:
    assert done["generate"].result()["complete"]
    assert done["verify"].code == 0, done["verify"].err
    dataset = Dataset.open(work / "data")
    # A pebble over the border makes the mesh wider than its floor.
    assert dataset.manifest["tile"]["triangles"] == 3 * 320 + 2
    assert dataset.geometry() is None
    test = dataset.load("test")
    value = 0.5 * (test["value_a"] + test["value_b"])
    assert (value.mean(axis=0)[0] > 1.2 * value.mean(axis=0)[1:]).all()


def test_pictures_are_drawn(work: Path, done: dict[str, Done]) -> None:
    for name in ("reference", "preview"):
        assert done[name].code == 0, done[name].err
    with Image.open(work / "preview/beauty.png") as picture:
        assert np.asarray(picture).std() > 5
