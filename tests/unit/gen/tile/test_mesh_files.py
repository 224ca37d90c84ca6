"""Mesh files: what is read, and that nothing else raises but one clear line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fuzzing import damaged, loads_or_refuses
from support.gltf_files import TWO_TRIANGLES, GltfBuilder
from support.jobs import job_of

from mbtf_gen.planning.run_plan import plan_effects
from mbtf_gen.tile.loading import load_material

OBJ = "v 0 0 0\nv 2 0 0\nv 2 1 0.1\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
2 0 0
2 1 0.1
0 1 0
3 0 1 2
3 0 2 3
"""


def bumps(period: float = 1.0) -> trimesh.Trimesh:
    """A wavy sheet that tiles."""
    n = 9
    x, y = np.meshgrid(np.linspace(0, period, n), np.linspace(0, period, n))
    z = 0.1 * np.sin(2 * np.pi * x / period) * np.cos(2 * np.pi * y / period)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, process=False)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_files_hold_the_same_tile(tmp_path: Path, suffix: str) -> None:
    mesh = bumps(2.5)
    if suffix == ".glb":
        # glTF has y up.
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.export(tmp_path / f"a{suffix}")
    shape = load_material(tmp_path / f"a{suffix}")
    assert (shape.aspect, shape.thickness) == pytest.approx((1.0, 0.08), rel=1e-5)
    assert len(shape.faces) == 128
    assert shape.vertices[:, 2].max() == pytest.approx(0.0, abs=1e-9)
    # Opposite borders fit.
    assert shape.open_edges() == (0, 0)
    assert load_material(tmp_path / f"a{suffix}").warnings == ()


def test_corners_are_placed_by_the_axis_the_bounds_and_the_width(tmp_path: Path) -> None:
    # No face uses the last vertex; y is up in glTF.
    rows = np.array(((1, 5, -1), (3, 5, -1), (3, 6, -5), (1, 5, -5), (100, 100, 100)), np.float32)
    builder = GltfBuilder()
    builder.node(builder.mesh(rows))
    shape = load_material(builder.write(tmp_path / "a.glb"))
    # Two wide along x and four along -z, one high.
    corners = np.array([(0, 0, -0.5), (1, 0, -0.5), (1, 2, 0), (0, 2, -0.5)])
    assert shape.vertices[shape.faces] == pytest.approx(corners[TWO_TRIANGLES.reshape(-1, 3)])
    assert (shape.aspect, shape.thickness) == (2, 0.5)


def test_corners_at_one_place_are_one(tmp_path: Path) -> None:
    bumps().export(tmp_path / "a.ply")
    shape = load_material(tmp_path / "a.ply")
    corners = shape.vertices[shape.faces].reshape(-1, 3)
    noise = np.random.default_rng(0).uniform(-4e-7, 4e-7, corners.shape)
    faces = np.arange(len(corners)).reshape(-1, 3)
    for moved, edges in ((corners + noise, 0), (corners + 100 * noise, 3 * len(faces))):
        assert replace(shape, vertices=moved, faces=faces).open_edges()[0] == pytest.approx(edges, abs=10)


def test_copies_cover_what_reaches_over_the_border(tmp_path: Path) -> None:
    mesh = bumps()
    mesh.apply_translation([0.3, 0.2, 0])
    mesh.export(tmp_path / "a.ply")
    shape = load_material(tmp_path / "a.ply")
    number, shift = shape.copies()
    corners = shape.vertices[shape.faces[number], :2] + shift[:, None, :2]
    # The triangles' areas within the box add up to the box.
    assert (corners.max(axis=1) >= -1e-6).all()
    assert (corners.min(axis=1) <= 1 + 1e-6).all()
    inside = np.random.default_rng(0).random((500, 2))
    a, b, c = (corners[None, :, k] for k in range(3))
    p = inside[:, None]

    def side(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        (x, y), (dx, dy) = np.moveaxis(p - u, -1, 0), np.moveaxis(v - u, -1, 0)
        return dx * y - dy * x

    hits = ((side(a, b) > 0) & (side(b, c) > 0) & (side(c, a) > 0)).sum(axis=1)
    assert (hits == 1).all()


SAMPLES = {".ply": PLY.encode(), ".obj": OBJ.encode(), ".glb": bumps().export(file_type="glb")}


@given(data=st.data())
@settings(max_examples=60)
def test_damaged_files(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    kind, content = data.draw(damaged(SAMPLES))
    path = tmp_path_factory.mktemp("fuzz") / f"a{kind}"
    path.write_bytes(content)
    tile = loads_or_refuses(lambda: load_material(path))
    assert tile is None or np.isfinite(tile.thickness)


def test_the_material_file_replaces_the_reflectance(tmp_path: Path) -> None:
    bumps().export(tmp_path / "a.ply")
    path = tmp_path / "m.yaml"
    path.write_text("mesh: a.ply\nbase_color: [0.1, 0.2, 0.3]\nroughness: 0.4\n")
    (part,) = load_material(path).parts
    assert np.asarray(part.maps["base_color"]).tolist() == [0.1, 0.2, 0.3]
    assert [float(part.maps[name]) for name in ("roughness", "metallic", "specular")] == [0.4, 0.0, 0.5]
    digests = load_material(path).digests
    path.write_text("mesh: a.ply\nbase_color: [0.1, 0.2, 0.3]\nroughness: 0.5\n")
    assert load_material(path).digests != digests


def test_a_flat_mesh_is_zero_thick_and_traced_as_a_mesh(tmp_path: Path) -> None:
    (tmp_path / "flat.ply").write_text(PLY.replace("0.1", "0"))
    shape = load_material(tmp_path / "flat.ply")
    assert f"{shape.thickness:g}" == "0"
    # Where a ray meets a height map without heights is known, but not the triangle of a mesh.
    assert "parallax" in {e.name for e in plan_effects(job_of(shape), pilots=False).effects if e.on}
