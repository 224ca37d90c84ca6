"""Textures and meshes of a page; the browser tests compare what the page reads of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbtf_core.errors import InputError
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
            read_shape(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        read_shape(tmp_path / "nothing.obj")
    (tmp_path / "good.obj").write_text(plain + "vt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    monkeypatch.setattr("mbtf_fit.viewer.extras.MOST_TRIANGLES", 0)
    with pytest.raises(InputError, match="1 triangles, more than 0"):
        read_shape(tmp_path / "good.obj")


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


def test_smooth_textures_compress_well() -> None:
    x = np.linspace(0, 6, 128)
    smooth = np.sin(x)[:, None, None] * np.cos(x)[None, :, None] * np.ones(2)
    assert len(pack([smooth.astype(np.float32)]).description["data"]) < 0.5 * smooth.size
    with pytest.raises(InputError, match="not finite"):
        pack([np.full((2, 2, 1), np.inf, np.float32)])
