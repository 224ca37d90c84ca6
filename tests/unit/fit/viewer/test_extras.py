"""Meshes, surroundings and reference pictures of a page."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mbtf_core.errors import InputError
from mbtf_fit.viewer import extras
from mbtf_fit.viewer.extras import environment_content, mesh_content, pictures_content, tangents


def floats(text: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), np.float32).reshape(shape)


@pytest.mark.parametrize("mirrored", [False, True])
def test_tangents_follow_the_texture(mirrored: bool) -> None:
    """Of a plane whose u runs along (3, 4, 0) / 5, and whose v along the normal's cross product with it."""
    along, across = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    uv = np.array([[0, 0], [2, 0], [0, 1], [2, 1]], np.float64)
    vertices = uv[:, :1] * along + uv[:, 1:] * across
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    if mirrored:
        uv = uv * (1, -1)
    found = tangents(vertices, np.tile([0.0, 0.0, 1.0], (4, 1)), uv, faces)
    np.testing.assert_allclose(found[:, :3], np.tile(along, (4, 1)), atol=1e-12)
    assert (found[:, 3] == (-1 if mirrored else 1)).all()


def test_a_mesh_is_centered_with_z_up(tmp_path: Path) -> None:
    """A square of side 2 in a file's xz plane, with a quarter of the texture."""
    path = tmp_path / "square.obj"
    corners = [(4, 7, 0), (6, 7, 0), (6, 7, -2), (4, 7, -2)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += ["vt 0 0", "vt 0.5 0", "vt 0.5 0.5", "vt 0 0.5", "vn 0 1 0"]
    path.write_text("\n".join([*lines, "f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]) + "\n")
    mesh = mesh_content(path)
    positions = floats(mesh["positions"], -1, 3)
    assert np.linalg.norm(positions, axis=1) == pytest.approx(np.ones(len(positions)), abs=1e-6)
    np.testing.assert_allclose(positions[:, 2], 0, atol=1e-7)
    np.testing.assert_allclose(
        floats(mesh["normals"], -1, 3), np.tile([0, 0, 1], (len(positions), 1)), atol=1e-6
    )
    # The texture's v runs along the file's -z, which is our y.
    uv = floats(mesh["uvs"], -1, 2)
    np.testing.assert_allclose(np.sign(positions[:, 1]), np.sign(uv[:, 1] - 0.25))
    assert (floats(mesh["tangents"], -1, 4)[:, 3] == 1).all()
    # Half a texture unit is as long as the square's side √2.
    assert mesh["unit"] == pytest.approx(0.5 / np.sqrt(2))


def test_bad_meshes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    for name, text, what in (
        ("none.obj", plain + "f 1 2 3\n", "no texture coordinates"),
        ("flat.obj", plain + "vt 0 0\nf 1/1 2/1 3/1\n", "without an area"),
        ("empty.obj", "v 0 0 0\n", "cannot be read|no triangles"),
        ("text.glb", "no mesh", "cannot be read"),
        ("mesh.txt", "", "is not a mesh"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=what):
            mesh_content(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        mesh_content(tmp_path / "nothing.obj")
    (tmp_path / "good.obj").write_text(plain + "vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    monkeypatch.setattr(extras, "MOST_TRIANGLES", 0)
    with pytest.raises(InputError, match="1 triangles; a page holds 0"):
        mesh_content(tmp_path / "good.obj")


def test_surroundings_are_linear_and_small(tmp_path: Path) -> None:
    sky = np.zeros((200, 400, 3), np.float32)
    sky[:100] = (0.25, 0.5, 4.0)
    np.save(tmp_path / "sky.npy", sky)
    found = environment_content(tmp_path / "sky.npy")
    assert (found["name"], found["shape"]) == ("sky", [64, 128])
    values = floats(found["data"], 64, 128, 3)
    np.testing.assert_allclose(values[:31], np.broadcast_to(sky[0, 0], (31, 128, 3)), rtol=1e-5)
    assert values[34:].max() == 0
    Image.fromarray(np.full((2, 4, 3), 188, np.uint8)).save(tmp_path / "gray.png")
    np.testing.assert_allclose(
        floats(environment_content(tmp_path / "gray.png")["data"], 2, 4, 3), 0.5029, rtol=1e-3
    )
    # Radiance's RGBE: a mantissa of 128 and an exponent of 129 are 1.
    pixels = bytes([128, 64, 32, 129]) * 8
    (tmp_path / "one.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n" + pixels)
    one = floats(environment_content(tmp_path / "one.hdr")["data"], 2, 4, 3)
    np.testing.assert_allclose(one[0, 0], (1, 0.5, 0.25), rtol=0.01)
    (tmp_path / "bad.hdr").write_bytes(b"#?RADIANCE\n")
    for name, what in (
        ("bad.hdr", "Radiance picture"),
        ("none.hdr", "no such file"),
        ("none.png", "no such file"),
    ):
        with pytest.raises(InputError, match=what):
            environment_content(tmp_path / name)


def test_folders_without_pictures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no pictures of mbtf-gen reference"):
        pictures_content(tmp_path)
    for record in ({"kind": "preview"}, {"kind": "reference"}):
        (tmp_path / "pictures.json").write_text(json.dumps(record))
        with pytest.raises(InputError, match="no pictures of mbtf-gen reference"):
            pictures_content(tmp_path)
    options = {"view": {"elevation": 40, "azimuth": 0}, "light": {}, "tiles_across": [2]}
    record = {"kind": "reference", "depends": {"reference": options}, "pictures": {}}
    (tmp_path / "pictures.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match="no finished picture"):
        pictures_content(tmp_path)
