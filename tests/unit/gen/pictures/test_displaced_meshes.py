"""Meshes with texture coordinates that a material displaces, in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.scenes import mi

from mbtf_core.app.console import Console
from mbtf_core.data.shard_files import read_exr
from mbtf_core.errors import InputError
from mbtf_gen.config.pictures import ReferenceConfig
from mbtf_gen.pictures.displaced_mesh import DisplacedMesh, _pieces
from mbtf_gen.pictures.reference import render_references
from mbtf_gen.tile.heights import HeightGrid

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
UV = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"


def written(folder: Path, text: str) -> Path:
    """A mesh in a file."""
    (folder / "sheet.obj").write_text(text)
    return folder / "sheet.obj"


def test_pieces_cover_triangles_and_lie_in_half_cells() -> None:
    random = np.random.default_rng(0)
    places, faces = random.uniform(-5, 5, (60, 2)), np.arange(60).reshape(-1, 3)
    covered = np.zeros(len(faces))
    for face, weights in _pieces(places, faces):
        assert weights.min() > -1e-12
        np.add.at(covered, face, np.abs(np.linalg.det(weights)))
        at = np.einsum("tvk,tkd->tvd", weights, places[faces[face]])
        for line in (at[..., 0], at[..., 1], at.sum(-1)):
            assert (np.floor(line.mean(1) + 1e-9) <= line.min(1) + 1e-9).all()
            assert (np.ceil(line.mean(1) - 1e-9) >= line.max(1) - 1e-9).all()
    np.testing.assert_allclose(covered, 1.0, atol=1e-7)


def test_heights_are_those_of_the_grid_on_any_triangles(tmp_path: Path) -> None:
    """On a square of two tile widths, one half mirrored."""
    z = np.random.default_rng(1).uniform(-1, 0, (3, 5))
    grid = HeightGrid(z, 0.5)
    mirrored = UV + UV.replace("vt 1", "vt -1") + "f 1/1 2/2 3/3\nf 1/5 3/7 4/8\n"
    mesh = DisplacedMesh.read(written(tmp_path, SQUARE + mirrored), 2.0, 0.5, None)
    assert (mesh.width, mesh.radius) == (pytest.approx(np.ones(6)), pytest.approx(np.sqrt(2)))
    parameters = mi.traverse(mesh.mesh(grid, {"type": "diffuse"}))
    p, uv = (np.array(parameters[f"vertex_{name}"]) for name in ("positions", "texcoords"))
    p, uv = p.reshape(-1, 3), uv.reshape(-1, 2)
    places = np.stack([uv[:, 0] * 5, (1.0 - uv[:, 1]) * 3], -1) - 0.5
    np.testing.assert_allclose(p[:, 2], grid.at(places), atol=1e-5)
    corners = p.reshape(-1, 3, 3)
    assert np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2].min() > 0


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (SQUARE + "f 1 2 3\n", "no texture coordinates"),
        (SQUARE + "vt 0 0\nf 1/1 2/1 3/1\n", "1 of 1 triangles have no area in texture coordinates"),
        (SQUARE + UV + "f 1/1 2/2 1/3\n", "0 of 0 triangles"),
        (SQUARE.replace("1 1 0", "1 nan 0") + UV + FACES, "not finite"),
        ("o nothing\n", "no triangles"),
    ],
)
def test_meshes_that_cannot_be_displaced(text: str, what: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=what):
        DisplacedMesh.read(written(tmp_path, text), 2.0, 1.0, None)


def test_too_many_triangles_are_refused(tmp_path: Path) -> None:
    mesh = DisplacedMesh.read(written(tmp_path, SQUARE + UV + FACES), 100.0, 1.0, None)
    with pytest.raises(InputError, match="at most 16,777,216") as caught:
        mesh.mesh(HeightGrid(np.zeros((1024, 1024)), 1.0), {"type": "diffuse"})
    assert caught.value.hint == "give --mesh 40, or fewer --tiles-per-uv"


def test_a_picture_of_a_mesh(tmp_path: Path) -> None:
    """Of a white square that lies on its side, in the light of the camera; another mesh of the same name is
    not mistaken for it."""
    np.save(tmp_path / "heights.npy", np.zeros((4, 4), np.float32))
    (tmp_path / "flat.yaml").write_text("height: heights.npy\nbase_color: [1.0, 1.0, 1.0]\n")
    at = "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0 1\n"
    path = written(tmp_path, at + UV + "f 1/1 3/3 2/2\nf 1/1 4/4 3/3\n")
    view = {"surface": str(path), "tiles": 3, "up": "y", "size": 32, "spp": 4}
    view |= {"view": "90,0", "light": "90,0"}
    config = ReferenceConfig.model_validate({"material": str(tmp_path / "flat.yaml"), "reference": view})
    render_references(config, tmp_path / "out", Console(quiet=True))
    value = read_exr(tmp_path / "out" / "sheet-tiles6.exr", ("value_a", "transmittance"))
    seen = 1.0 - value["transmittance"]
    assert float(seen.mean()) == pytest.approx(0.25, rel=0.02)
    assert float(value["value_a"].mean()) == pytest.approx(0.25 / np.pi, rel=0.02)
    path.write_text(path.read_text().replace("-1 0 -1", "-1 0 -2"))
    with pytest.raises(InputError):
        render_references(config, tmp_path / "out", Console(quiet=True))
