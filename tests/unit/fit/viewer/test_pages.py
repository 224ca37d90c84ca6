"""The viewer's pages, their textures and meshes, and the commands that write and serve them."""

from __future__ import annotations

import http.client
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.pages import loads
from support.plugin_materials import write_material

from mbtf_core.app.console import run
from mbtf_core.errors import UsageError
from mbtf_fit.cli.app import app
from mbtf_fit.viewer.extras import read_shape
from mbtf_fit.viewer.page import safe_json, write_page
from mbtf_fit.viewer.server import PageServer
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


def test_a_page_loads_nothing_and_has_the_same_bytes_again(tmp_path: Path) -> None:
    write_material(tmp_path / "material", model="relief")
    words = ["export", str(tmp_path / "material"), "--to", "web", "-q", "-o"]
    for name in ("a", "b", "b"):
        assert run(app, [*words, str(tmp_path / name)]) == 0
    html = (tmp_path / "a" / "viewer.html").read_text()
    assert html == (tmp_path / "b" / "viewer.html").read_text()
    assert loads(html).external == []
    assert "default-src 'none'" in html
    assert "connect-src 'none'" in html


def test_text_cannot_end_the_script() -> None:
    text = safe_json({"name": "</script><!-- & \u2028 é"})
    assert not set(text) & set("<>&\u2028é")
    assert json.loads(text) == {"name": "</script><!-- & \u2028 é"}
    assert "<b>" not in write_page({"materials": []}, "<b>bold</b>")


def test_only_this_machine_gets_the_page() -> None:
    server = PageServer("<p>page</p>")
    try:
        host, port = "127.0.0.1", int(server.url.rstrip("/").rpartition(":")[2])

        def get(path: str, name: str) -> tuple[int, bytes]:
            connection = http.client.HTTPConnection(host, port, timeout=10)
            connection.request("GET", path, headers={"Host": name})
            answer = connection.getresponse()
            return answer.status, answer.read()

        assert get("/", f"{host}:{port}") == (200, b"<p>page</p>")
        assert get("/?x", f"localhost:{port}")[0] == 200
        assert get("/etc/passwd", f"{host}:{port}")[0] == 404
        assert get("/", f"elsewhere.example:{port}")[0] == 404
        with pytest.raises(UsageError, match="cannot listen"):
            PageServer("", port)
    finally:
        server.close()
