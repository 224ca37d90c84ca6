"""OBJ files against hand-made numbers, trimesh and Mitsuba's own loader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshContent, MeshShape, Texture
from mbtf_core.meshes.obj import read_obj
from mbtf_core.meshes.polygons import triangulate

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 1\n"
FACES = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
# Red, green and, below, blue and white.
QUAD = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)


def read(folder: Path, text: str, **files: str) -> MeshContent:
    """An OBJ file, beside others: ``a_mtl`` is ``a.mtl``."""
    for name, content in files.items():
        (folder / name.replace("_", ".")).write_text(content)
    (folder / "a.obj").write_text(text)
    return read_obj(folder / "a.obj")


def with_material(folder: Path, text: str) -> MeshContent:
    return read(folder, f"mtllib a.mtl\n{SQUARE}usemtl m\n{FACES}", a_mtl=f"newmtl m\n{text}\n")


def texture_of(content: MeshContent, role: str = "base_color") -> tuple[Texture, Any]:
    (shape,) = content.shapes
    assert not shape.faults
    texture, factor = shape.values[role]
    return texture, factor


def corners(shape: MeshShape) -> NDArray[np.float64]:
    """Corners (m, 3, 3) of the triangles."""
    return shape.vertices[shape.faces]


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3\nf 1 3 4",
        "f 1/1 2/2 3/3\nf 1/1 3/3 4/4",
        "f 1//1 2//1 3//1\nf 1//1 3//1 4//1",
        "f -4/-4/-1 -3/-3/-1 -2/-2/-1\nf -4/-4/-1 -2/-2/-1 -1/-1/-1",
        "f 1/1 2/2/1 3/3/\nf 1 3//1 4",
        "\tf  1/1 2/2 \\\n3/3 4/4 # a square\r",
    ],
)
def test_all_forms_of_faces(tmp_path: Path, faces: str) -> None:
    shapes = read(tmp_path, SQUARE + faces + "\n").shapes
    found = np.concatenate([corners(shape) for shape in shapes])
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    order = np.argsort(found[:, 1, 1])
    np.testing.assert_array_equal(found[order], square[[[0, 1, 2], [0, 2, 3]]])
    for shape in shapes:
        if shape.uv is not None:
            np.testing.assert_array_equal(shape.uv, shape.vertices[:, :2])
        if shape.normals is not None:
            np.testing.assert_array_equal(shape.normals, np.tile([0, 0, 1], (len(shape.normals), 1)))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("f 1 2 5", "lacks"),
        ("f 1 2 x", "numbers"),
        ("f 1/1/1/1 2/2/1/1 3/3/1/1", "numbers"),
        ("f 1 2", "no triangles"),
        ("v 1 2\nf 1 2 3", "x, y, z"),
        ("v 1 2-3\nf 1 2 3", "numbers"),
        ("vt 1 2 3 4 5 6 7\nf 1 2 3", "numbers"),
        ("f 1 2 99999999999999999999999", "lacks"),
        ("\0", "text"),
    ],
)
def test_faults_are_refused_with_their_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        read(tmp_path, SQUARE + text + "\n")
    if says in ("lacks", "numbers", "x, y, z"):
        assert "line 10" in str(error.value.where)


@pytest.mark.parametrize("turned", [False, True])
def test_polygons_are_cut_exactly(turned: bool) -> None:
    rng = np.random.default_rng(0)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0] if turned else np.eye(3)
    star = 2 * np.pi * np.arange(20) / 20
    radius = np.where(np.arange(20) % 2, 1.0, 0.3)
    polygons = [
        [[0, 0], [1, 0], [1, 1]],
        [[0, 0], [1, 0], [1, 1], [0, 1]],
        # An arrow, an L whose corner lies on a diagonal, and a frame whose hole is joined by a bridge.
        [[0, 0], [1, 0.3], [2, 0], [1, 2]],
        [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]],
        [[0, 0], [3, 0], [3, 3], [0, 3], [0, 0], [1, 1], [1, 2], [2, 2], [2, 1], [1, 1]],
        np.stack([radius * np.cos(star), radius * np.sin(star)], axis=-1),
    ]
    areas = [0.5, 1, 1.7, 3, 8, 10 * 0.3 * np.sin(np.pi / 10)]
    points = np.concatenate([np.pad(np.array(p, float), ((0, 0), (0, 1))) @ rotation.T + 5 for p in polygons])
    triangles, polygon, crossing = triangulate(points, np.array([len(p) for p in polygons]))
    assert crossing == 0
    corner = points[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    # Unsigned areas add up only if no triangles overlap; all turn the same way.
    found = np.bincount(polygon, np.linalg.norm(normal, axis=1))
    np.testing.assert_allclose(found, areas, rtol=1e-9)
    assert (normal @ rotation[:, 2] > -1e-12).all()
    bent = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 2, 0], [-1, 1, 0]], float)
    assert triangulate(bent, np.array([5]))[2] == 1


def test_trimesh_and_mitsuba_read_the_same(tmp_path: Path) -> None:
    from mbtf_gen.engine.runtime import load_mitsuba

    mi = load_mitsuba()
    sphere = trimesh.creation.uv_sphere(count=(6, 8))
    sphere.visual = trimesh.visual.TextureVisuals(
        uv=np.random.default_rng(0).random((len(sphere.vertices), 2))
    )
    sphere.export(tmp_path / "a.obj")
    (shape,) = read_obj(tmp_path / "a.obj").shapes
    np.testing.assert_allclose(corners(shape), sphere.triangles, atol=1e-7)
    np.testing.assert_allclose(shape.uv[shape.faces], sphere.visual.uv[sphere.faces], atol=1e-7)
    params = mi.traverse(mi.load_dict({"type": "obj", "filename": str(tmp_path / "a.obj")}))
    faces = np.array(params["faces"]).reshape(-1, 3)
    np.testing.assert_allclose(
        np.array(params["vertex_positions"]).reshape(-1, 3)[faces], corners(shape), atol=1e-6
    )
    texture = np.array(params["vertex_texcoords"]).reshape(-1, 2)[faces]
    # Mitsuba's v points down.
    np.testing.assert_allclose(texture * (1, -1) + (0, 1), shape.uv[shape.faces], atol=1e-6)


def test_parts_are_those_of_materials_and_of_texture_coordinates(tmp_path: Path) -> None:
    faces = "usemtl b\nf 1/1 2/2 3/3\nusemtl a\nf 1 3 4\nusemtl b\nf 1 2 3\n"
    content = read(
        tmp_path,
        f"mtllib my own.mtl other.mtl\n{SQUARE}{faces}",
        **{
            "my own_mtl": "newmtl a\nKd .1 .2 .3\n",
            "other_mtl": "# of Blender\nnewmtl b\n  kd 0.5\nPr 0.25\nPm 1\n",
        },
    )
    found = {(shape.name, shape.uv is not None): shape for shape in content.shapes}
    assert found.keys() == {("b", True), ("b", False), ("a", False)}
    assert found["a", False].values["base_color"].tolist() == [0.1, 0.2, 0.3]
    for textured in (False, True):
        values = found["b", textured].values
        assert values["base_color"].tolist() == [0.5, 0.5, 0.5]
        assert (values["roughness"], values["metallic"]) == (0.25, 1.0)
    assert content.files == {name: tmp_path / name for name in ("my own.mtl", "other.mtl")}
    assert content.up is None


@pytest.mark.parametrize(
    ("text", "matrix", "wrap"),
    [
        ("my quad.png", [[1, 0, 0], [0, 1, 0]], "repeat"),
        ("-s 4 2 1 my quad.png", [[4, 0, 0], [0, 2, 0]], "repeat"),
        ("-o 0.25 0.5 -s 3 my quad.png", [[3, 0, 0.25], [0, 1, 0.5]], "repeat"),
        ("-clamp on -blendu on -mm 0 1 my quad.png", [[1, 0, 0], [0, 1, 0]], "clamp"),
        ('"MY Quad.png"', [[1, 0, 0], [0, 1, 0]], "repeat"),
        ("..\\a\\my quad.png", [[1, 0, 0], [0, 1, 0]], "repeat"),
    ],
)
def test_images_are_found_and_placed(tmp_path: Path, text: str, matrix: Any, wrap: str) -> None:
    Image.fromarray(QUAD).save(tmp_path / "my quad.png")
    content = with_material(tmp_path, f"Kd 0.5 0.25 1\nmap_Kd {text}")
    texture, factor = texture_of(content)
    np.testing.assert_array_equal(texture.pixels, QUAD / 255)
    np.testing.assert_array_equal(texture.to_uv, matrix)
    assert texture.wrap == (wrap, wrap)
    assert factor.tolist() == [0.5, 0.25, 1.0]
    assert tmp_path / "my quad.png" in content.files.values()
    assert sum("darkens" not in text for text in content.warnings) == ("\\" in text)


def test_colors_of_images_are_srgb_and_numbers_are_linear(tmp_path: Path) -> None:
    Image.fromarray(np.full((1, 1, 3), 188, np.uint8)).save(tmp_path / "a.png")
    # White everywhere, the first texel transparent.
    leaf = np.full((1, 2, 4), 255, np.uint8)
    leaf[0, 0, 3] = 0
    Image.fromarray(leaf).save(tmp_path / "leaf.png")
    content = with_material(
        tmp_path, "map_Kd a.png\nmap_Pr -imfchan g a.png\nPm 0.5\nmap_Pm a.png\nmap_d leaf.png"
    )
    assert texture_of(content)[0].pixels == pytest.approx(0.5029, abs=1e-4)
    for role, factor in (("roughness", 1.0), ("metallic", 0.5)):
        assert texture_of(content, role)[0].pixels == pytest.approx(188 / 255)
        assert texture_of(content, role)[1] == factor
    assert texture_of(content, "opacity")[0].pixels.tolist() == [[0, 1]]


def test_colors_of_vertices_are_srgb_factors(tmp_path: Path) -> None:
    colored = "v 0 0 0 1 0 0\nv 1 0 0 0.5 0.5 0.5\nv 0 1 0 0 0 1\nf 1 2 3\n"
    (shape,) = read(tmp_path, colored).shapes
    np.testing.assert_allclose(shape.colors, [[1, 0, 0], [0.2140] * 3, [0, 0, 1]], atol=1e-4)
    assert shape.values["base_color"].tolist() == [1, 1, 1]
    assert "base_color" in read(tmp_path, colored.replace("0.5 0.5 0.5", "255 0 0")).shapes[0].faults
