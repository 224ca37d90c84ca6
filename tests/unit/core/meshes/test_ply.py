"""PLY files, as text and in both byte orders, against hand-made numbers, trimesh and Mitsuba's own loader."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshContent
from mbtf_core.meshes.ply import read_ply

FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {"char": "i1", "uchar": "u1", "ushort": "u2", "int": "i4", "float": "f4", "double": "f8"}
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
XYZ = ["float x", "float y", "float z"]
CORNERS = "list uchar int vertex_indices"
TRIANGLES = [([0, 1, 2],), ([0, 2, 3],)]


def ply(
    elements: dict[str, tuple[list[str], list[Any]]], kind: str = "ascii", comments: tuple[str, ...] = ()
) -> bytes:
    """A file of elements: their properties and rows."""
    lines = ["ply", f"format {kind} 1.0", *(f"comment {text}" for text in comments)]
    body = b""
    for name, (properties, rows) in elements.items():
        lines += [f"element {name} {len(rows)}", *(f"property {text}" for text in properties)]
        for row in rows:
            flat: list[tuple[str, Any]] = []
            for text, value in zip(properties, row, strict=True):
                words = text.split()
                if words[0] == "list":
                    flat += [(words[1], len(value)), *((words[2], number) for number in value)]
                else:
                    flat.append((words[0], value))
            if kind == "ascii":
                body += " ".join(str(value) for _, value in flat).encode() + b"\n"
            else:
                body += b"".join(np.array(v).astype(FORMATS[kind] + TYPES[t]).tobytes() for t, v in flat)
    return "\n".join([*lines, "end_header", ""]).encode() + body


def read(folder: Path, data: bytes) -> MeshContent:
    (folder / "a.ply").write_bytes(data)
    return read_ply(folder / "a.ply")


@pytest.mark.parametrize("kind", FORMATS)
def test_polygons_with_colors_and_texture_coordinates_of_vertices(tmp_path: Path, kind: str) -> None:
    vertices = [(*p, *p[:2], 255, 188, 0, 255) for p in [*SQUARE, (2, 0, 0)]]
    properties = [*XYZ, "float s", "double t", *(f"uchar {c}" for c in ("red", "green", "blue", "alpha"))]
    # A quadrilateral and a triangle: rows of different lengths.
    faces = [(7, [0, 1, 2, 3]), (7, [1, 4, 2])]
    data = ply({"vertex": (properties, vertices), "face": (["char flags", CORNERS], faces)}, kind)
    content = read(tmp_path, data)
    (shape,) = content.shapes
    corners = np.array([*SQUARE, (2, 0, 0)])[[[0, 1, 2], [0, 2, 3], [1, 4, 2]]]
    assert shape.vertices[shape.faces].tolist() == corners.tolist()
    np.testing.assert_array_equal(shape.uv, shape.vertices[:, :2])
    np.testing.assert_allclose(shape.colors, np.tile([1, 0.5029, 0], (5, 1)), atol=1e-4)
    assert shape.values["base_color"].tolist() == [1, 1, 1]
    (warning,) = content.warnings
    assert "flags" in warning
    assert "alpha" not in warning


@pytest.mark.parametrize("kind", FORMATS)
def test_texture_coordinates_and_colors_of_faces(tmp_path: Path, kind: str) -> None:
    Image.fromarray(np.full((2, 2, 3), 188, np.uint8)).save(tmp_path / "my atlas.png")
    properties = [CORNERS, "list uchar float texcoord", "float red", "float green", "float blue"]
    faces = [([0, 1, 2], [0, 0, 1, 0, 1, 1], 1, 1, 1), ([0, 2, 3], [], 1, 1, 1)]
    elements = {"vertex": (XYZ, SQUARE), "face": (properties, faces)}
    content = read(tmp_path, ply(elements, kind, ("made by hand", "TextureFile my atlas.png")))
    bare, textured = content.shapes
    assert bare.uv is None
    np.testing.assert_array_equal(textured.uv[textured.faces], [[[0, 0], [1, 0], [1, 1]]])
    texture, factor = textured.values["base_color"]
    assert texture.pixels == pytest.approx(0.5029, abs=1e-4)
    assert factor.tolist() == [1, 1, 1]
    assert content.files == {"my atlas.png": tmp_path / "my atlas.png"}
    # Without an image, the colors of the faces count.
    elements["face"] = (properties, [(*faces[0][:2], 0.25, 0.5, 1), (*faces[1][:2], 0.5, 0.5, 0)])
    colors = {shape.uv is None: shape.colors for shape in read(tmp_path, ply(elements, kind)).shapes}
    np.testing.assert_allclose(colors[False], np.tile([0.25, 0.5, 1], (3, 1)))
    np.testing.assert_allclose(colors[True], np.tile([0.5, 0.5, 0], (3, 1)))


WHOLE = ply({"vertex": (XYZ, SQUARE), "face": ([CORNERS], TRIANGLES)}, "binary_little_endian")
TEXT = ply({"vertex": (XYZ, SQUARE), "face": ([CORNERS], TRIANGLES)})


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (WHOLE[:-1], "complete"),
        (WHOLE.replace(b"vertex 4", b"vertex 300000000"), "300,000,000"),
        (TEXT.replace(b"vertex 4", b"vertex 300000000"), "300,000,000"),
        (TEXT.replace(b"3 0 2 3", b"3000000000 0 2 3"), "list|complete"),
        (TEXT.replace(b"vertex 4", b"vertex " + b"4" * 5000), "no line of a PLY header"),
        (TEXT.replace(b"3 0 2 3", b"3 0 2 -1"), "lacks"),
        (TEXT.replace(b"3 0 2 3", b"3 0 1.5 3"), "lacks"),
        (TEXT.replace(b"float x", b"float a"), "x, y and z"),
        (TEXT.replace(b"end_header", b"end"), "header"),
        (ply({"vertex": (XYZ, SQUARE)}), "cloud of points"),
    ],
)
def test_damaged_and_other_files_are_refused(tmp_path: Path, data: bytes, says: str) -> None:
    with pytest.raises(InputError, match=says) as error:
        read(tmp_path, data)
    assert "\n" not in error.value.what


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_trimesh_and_mitsuba_read_the_same(tmp_path: Path, encoding: str) -> None:
    from mbtf_gen.engine.runtime import load_mitsuba

    mi = load_mitsuba()
    sphere = trimesh.creation.icosphere(subdivisions=1)
    (tmp_path / "a.ply").write_bytes(sphere.export(file_type="ply", encoding=encoding))
    (shape,) = read_ply(tmp_path / "a.ply").shapes
    np.testing.assert_allclose(shape.vertices[shape.faces], sphere.triangles, atol=1e-6)
    params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(tmp_path / "a.ply")}))
    positions = np.array(params["vertex_positions"]).reshape(-1, 3)
    np.testing.assert_array_equal(
        positions[np.array(params["faces"]).reshape(-1, 3)], shape.vertices[shape.faces].astype(np.float32)
    )
