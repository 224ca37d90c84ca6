"""Textures and meshes of a page; the browser tests compare what the page reads of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from mbtf_fit.viewer.extras import read_shape
from mbtf_fit.viewer.textures import pack


def test_a_mesh_is_centered_with_z_up(tmp_path: Path) -> None:
    """A square of side 2 in a file's xz plane, with a quarter of the texture."""
    path = tmp_path / "square.obj"
    corners = [(4, 7, 0), (6, 7, 0), (6, 7, -2), (4, 7, -2)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["vt 0 0", "vt 0.5 0", "vt 0.5 0.5", "vt 0 0.5", "vn 0 1 0"]
    path.write_text("\n".join([*lines, "f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]) + "\n")
    shape, _, unit = read_shape(path)
    positions = shape["positions"]
    assert np.linalg.norm(positions, axis=1) == pytest.approx(np.ones(len(positions)), abs=1e-6)
    np.testing.assert_allclose(positions[:, 2], 0, atol=1e-7)
    np.testing.assert_allclose(shape["normals"], np.tile([0, 0, 1], (len(positions), 1)), atol=1e-6)
    # The texture's v runs along the file's -z, which is our y.
    uv = shape["uvs"]
    np.testing.assert_allclose(np.sign(positions[:, 1]), np.sign(uv[:, 1] - 0.25))
    assert (shape["tangents"][:, 3] == 1).all()
    # Half a texture unit is as long as the square's side √2.
    assert unit == pytest.approx(0.5 / np.sqrt(2))


def test_vertices_are_smooth_unless_the_file_has_normals(tmp_path: Path) -> None:
    """A box, whose corners have three faces each; one place of the texture makes them one vertex."""
    box = trimesh.creation.box()
    lines = ["v {} {} {}".format(*point) for point in box.vertices]
    lines += ["vt {} {}".format(*point) for point in box.vertices[:, :2]]
    faces = [[f"{n + 1}/{n + 1}" for n in face] for face in box.faces]
    (tmp_path / "a.obj").write_text("\n".join([*lines, *(f"f {' '.join(face)}" for face in faces)]) + "\n")
    turned = (1, -1, 1)
    shape, _, _ = read_shape(tmp_path / "a.obj")
    expected = box.vertex_normals[:, [0, 2, 1]] * turned
    near = np.linalg.norm(shape["normals"][:, None] - expected, axis=2).min(axis=1)
    np.testing.assert_allclose(near, 0, atol=1e-6)
    assert len(shape["normals"]) == 8
    lines += ["vn {} {} {}".format(*normal) for normal in box.face_normals]
    given = [" ".join(f"{corner}/{k + 1}" for corner in face) for k, face in enumerate(faces)]
    (tmp_path / "a.obj").write_text("\n".join([*lines, *(f"f {face}" for face in given)]) + "\n")
    shape, faces, _ = read_shape(tmp_path / "a.obj")
    np.testing.assert_array_equal(
        shape["normals"][faces], np.repeat((box.face_normals[:, [0, 2, 1]] * turned)[:, None], 3, axis=1)
    )


def test_normals_of_gltf_are_turned_with_its_nodes(tmp_path: Path) -> None:
    """A sphere that a node stretches and mirrors; its normals are those of the ellipsoid."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    visual = trimesh.visual.TextureVisuals(uv=ball.vertices[:, :2])
    ball = trimesh.Trimesh(
        ball.vertices, ball.faces, vertex_normals=ball.vertices, process=False, visual=visual
    )
    scene = trimesh.Scene()
    stretch = np.diag([-1.0, 2.0, 3.0, 1.0])
    scene.add_geometry(ball, transform=stretch)
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb", include_normals=True))
    shape, _, _ = read_shape(tmp_path / "a.glb")
    # Files have y up; the ellipsoid has the radii 1, 3, 2 along our axes.
    normals = shape["positions"] / np.square([1.0, 3.0, 2.0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(shape["normals"], normals, atol=1e-5)


@pytest.mark.parametrize("alike", [False, True])
@pytest.mark.parametrize("bits", [6, 16])
def test_texels_are_rounded_to_their_range(bits: int, alike: bool) -> None:
    random = np.random.default_rng(0)
    levels = [random.normal(size=(rows, 2 * rows, 3)).astype(np.float32) * (1, 10, 0) for rows in (1, 2, 7)]
    levels[2][3, 4, 0] = 40.0
    packed = pack([np.asarray(texels, np.float32) for texels in levels], bits, alike=alike)
    for found, given in zip(packed.levels, levels, strict=True):
        step = np.ptp(given, axis=(0, 1)) / (2**bits - 1)
        assert (np.abs(found - given) <= 0.5001 * step + 1e-5).all()
