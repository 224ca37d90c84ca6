"""Whole runs on cloth and on a mesh of two parts: data, pictures, repairs, and a fit with its preview."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from support.commands import Done, call, run_named

from mbtf_core.data.dataset import Dataset

# Loose yarns of few fibers, one and a half times as high as wide.
CLOTH = """weave: "X.\\n.X\\nXX"
yarn: {fibers: 6, radius: 4, width: 0.7}
yarns: {warp: {type: silk1, color: [0.8, 0.5, 0.2]}, weft: {type: rayon2, color: 0.3}}
warp: warp
weft: weft
resolution: 16
"""
SMALL = "--queries 12/texel --test-queries 256 --test-spp 64 --set output.shard_queries=1000"
LINES = {
    "generate": f"cloth.yaml {SMALL} -o data --json",
    "verify": "verify data",
    "plan": "plan cloth.yaml --queries 12/texel",
    "opaque": "plan cloth.yaml --queries 12/texel --effects=-transmission",
    "images": "cloth.yaml --queries 4/texel --test-queries 256 --layout image --patch-size 4 -o images",
    "inspect": "inspect cloth.yaml --json",
    "reference": "reference cloth.yaml --view 50,20 --tiles-across 1 --size 24 --spp 8 -o reference",
    "preview": "preview cloth.yaml -o preview --size 64 --spp 4 --set queries.train=3000",
}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cloth")
    (folder / "cloth.yaml").write_text(CLOTH)
    return folder


@pytest.fixture(scope="module")
def done(work: Path) -> dict[str, Done]:
    return run_named(LINES, work)


def test_a_data_set_holds_light_that_fibers_reflect_and_pass(work: Path, done: dict[str, Done]) -> None:
    summary = done["generate"].result()
    assert summary["complete"]
    assert (summary["lost"], summary["nonfinite"]) == (0, 0)
    assert done["verify"].code == 0, done["verify"].err
    dataset = Dataset.open(work / "data")
    tile, geometry = dataset.manifest["tile"], dataset.geometry()
    assert (tile["aspect"], geometry.aspect) == (1.5, 1.5)
    assert tile["fibers"] > 5 * 6 * 2
    assert 0.5 < geometry.opacity.mean() < 1.0
    np.testing.assert_allclose(geometry.tangent_moments[..., [0, 3, 5]].sum(-1), geometry.opacity, atol=1e-4)
    test = dataset.load("test")
    through = test["transmittance"]
    assert 0.02 < through.mean() < 0.9
    value = 0.5 * (test["value_a"] + test["value_b"]).mean(axis=-1)
    assert value.mean() > 0.01
    # Low views hardly see through; what they see is mostly cloth.
    low = test["omega_o"][:, 2] < 0.3
    assert through[low].mean() < 0.5 * through[~low].mean()
    assert Dataset.open(work / "images").load("test")["value_a"].shape[1:] == (4, 4, 3)


def test_the_plan_measures_multiple_scattering(done: dict[str, Done]) -> None:
    lines = {line[:23].strip(): line for line in done["plan"].out.splitlines()}
    for name, state in {
        "interreflection": "on",
        "opacity": "on",
        "fiber transmission": "on",
        "normal map": "off",
    }.items():
        assert f" {state} " in lines[name]
    (opaque,) = [line for line in done["opaque"].out.splitlines() if line.startswith("fiber transmission")]
    assert " off " in opaque


def test_pictures_and_description(work: Path, done: dict[str, Done]) -> None:
    for name in ("reference", "preview", "inspect"):
        assert done[name].code == 0, done[name].err
    found = done["inspect"].result()
    assert found["aspect"] == 1.5
    assert [yarn["color"][0] for yarn in found["yarns"].values()] == [0.8, 0.3]
    with Image.open(work / "preview/beauty.png") as picture:
        assert np.asarray(picture).std() > 5
    assert len(list((work / "reference").glob("*.exr"))) == 2


def test_a_fit_knows_the_fibers_by_default_and_draws_cloth(work: Path, done: dict[str, Done]) -> None:
    out = work / "material"
    fitted = call(["mbtf-fit", str(work / "data"), "--steps", "10", "--batch", "2048", "-o", str(out)])
    assert fitted.code == 0, fitted.err
    assert ": cloth, " in fitted.out
    assert "transmittance" in fitted.out
    small = ["--size", "64"]
    drawn = call(["mbtf-fit", "preview", str(out), "-o", str(work / "drawn"), *small])
    assert drawn.code == 0, drawn.err
    with Image.open(work / "drawn/sheet.png") as picture:
        assert np.asarray(picture).std() > 5


MESH_LINES = {
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
    done = run_named(MESH_LINES, tmp_path)
    assert done["generate"].result()["complete"]
    for name in ("verify", "reference", "preview"):
        assert done[name].code == 0, done[name].err
    dataset = Dataset.open(tmp_path / "data")
    # A pebble over the border makes the mesh wider than its floor.
    assert dataset.manifest["tile"]["triangles"] == 3 * 320 + 2
    geometry = dataset.geometry()
    assert geometry.base_color[..., 0].max() > 4 * geometry.base_color[..., 1].min()
    assert geometry.tangent_moments is None
    test = dataset.load("test")
    value = 0.5 * (test["value_a"] + test["value_b"])
    assert (value.mean(axis=0)[0] > 1.2 * value.mean(axis=0)[1:]).all()
    with Image.open(tmp_path / "preview/beauty.png") as picture:
        assert np.asarray(picture).std() > 5
