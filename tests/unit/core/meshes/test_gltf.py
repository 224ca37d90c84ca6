"""Triangles of glTF files against numbers by hand and other readers, and what is refused."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.gltf_files import SQUARE, SQUARE_UV, GltfBuilder

from mbtf_core.errors import InputError
from mbtf_core.meshes.content import MeshContent, MeshShape
from mbtf_core.meshes.read import read_mesh_content

TRIANGLE = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 3]], np.float32)


def content_of(builder: GltfBuilder, folder: Path, name: str = "a.glb") -> MeshContent:
    return read_mesh_content(builder.write(folder / name))


def shape_of(builder: GltfBuilder, folder: Path, name: str = "a.glb") -> MeshShape:
    (shape,) = content_of(builder, folder, name).shapes
    return shape


def with_triangle(**node: Any) -> GltfBuilder:
    builder = GltfBuilder()
    builder.node(builder.mesh(TRIANGLE, None), **node)
    return builder


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_both_containers_hold_the_same(tmp_path: Path, name: str) -> None:
    builder = GltfBuilder().plate()
    found = content_of(builder, tmp_path, name)
    (shape,) = found.shapes
    assert found.up == "y"
    assert list(found.files) == ([] if name == "a.glb" else ["a.bin"])
    assert shape.vertices.tolist() == SQUARE.tolist()
    assert shape.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    # v is up here, down in glTF.
    assert shape.uv.tolist() == [[0, 0], [1, 0], [1, 1], [0, 1]]


def test_a_data_uri_and_a_wrong_suffix_are_read(tmp_path: Path) -> None:
    builder = with_triangle()
    uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(builder.blob)).decode()
    (tmp_path / "a.glb").write_text("\ufeff" + json.dumps(builder.finished(uri)))
    found = read_mesh_content(tmp_path / "a.glb")
    assert found.shapes[0].vertices.tolist() == TRIANGLE.tolist()
    assert found.files == {}


@pytest.mark.parametrize(
    ("mode", "indices", "faces"),
    [
        (4, [3, 0, 1], [[3, 0, 1]]),
        (5, [0, 1, 2, 3, 0], [[0, 1, 2], [1, 3, 2], [2, 3, 0]]),
        (6, [0, 1, 2, 3], [[1, 2, 0], [2, 3, 0]]),
    ],
)
def test_triangles_strips_and_fans(
    tmp_path: Path, mode: int, indices: list[int], faces: list[list[int]]
) -> None:
    for kind in (np.uint8, np.uint16, np.uint32):
        builder = GltfBuilder()
        builder.node(builder.mesh(SQUARE, np.array(indices, kind), mode=mode))
        assert shape_of(builder, tmp_path).faces.tolist() == faces


@pytest.mark.parametrize(
    ("kind", "normalized", "factor"),
    [
        *((np.int8, True, 127), (np.uint8, True, 255), (np.int16, True, 32767), (np.uint16, True, 65535)),
        *((np.int16, False, 1), (np.float32, True, 1)),
    ],
)
def test_components_of_all_types(tmp_path: Path, kind: Any, normalized: bool, factor: int) -> None:
    codes = np.array([[1, 2, 3], [-128, 0, 5], [7, 120, 9]]).astype(kind)
    builder = GltfBuilder()
    builder.node(builder.mesh(builder.accessor(codes, normalized), None))
    # The smallest signed code is -1, too.
    expected = np.maximum(codes / factor, -1) if factor > 1 else codes
    assert shape_of(builder, tmp_path).vertices == pytest.approx(expected, rel=1e-12)


def test_strides_offsets_and_sparse_elements(tmp_path: Path) -> None:
    builder = GltfBuilder()
    # Positions and texture coordinates interleaved, 20 bytes a vertex, after 4 bytes of something else.
    rows = np.hstack([SQUARE, SQUARE_UV]).astype("<f4")
    view = builder.view(b"\xff" * 4 + rows.tobytes(), byteStride=20)
    of = {"bufferView": view, "componentType": 5126, "count": 4}
    position = builder.add("accessors", {**of, "byteOffset": 4, "type": "VEC3"})
    uv = builder.add("accessors", {**of, "byteOffset": 16, "type": "VEC2"})
    builder.node(builder.mesh(position, TEXCOORD_0=uv))
    # The second mesh moves two corners of zeros.
    values = np.array([9, 5, 0, 0, 0, 0, 6])  # from the second one on
    sparse = {
        "count": 2,
        "indices": {"bufferView": builder.view(bytes([0, 1, 2])), "byteOffset": 1, "componentType": 5121},
        "values": {"bufferView": builder.view(values.astype("<f4").tobytes()), "byteOffset": 4},
    }
    zeros = builder.add("accessors", {"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse})
    builder.node(builder.mesh(zeros, None))
    shapes = content_of(builder, tmp_path).shapes
    assert shapes[0].vertices.tolist() == SQUARE.tolist()
    assert shapes[0].uv[:, 0].tolist() == SQUARE_UV[:, 0].tolist()
    assert shapes[1].vertices.tolist() == [[0, 0, 0], [5, 0, 0], [0, 0, 6]]


def test_nodes_multiply_from_the_root(tmp_path: Path) -> None:
    builder = GltfBuilder()
    mesh = builder.mesh(TRIANGLE, None)
    # By columns: x → y, y → z, z → x, moved by (1, 2, 3).
    turn = [0, 1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 1, 2, 3, 1]
    leaf = builder.node(mesh, translation=[10, 0, 0], scale=[2, 3, -4])
    builder.node(children=[leaf], matrix=turn)
    moved = TRIANGLE * (2, 3, -4) + (10, 0, 0)
    shape = shape_of(builder, tmp_path)
    assert shape.vertices == pytest.approx(moved[:, [2, 0, 1]] + (1, 2, 3))
    # A mirrored triangle is counterclockwise from outside again.
    assert shape.faces.tolist() == [[2, 1, 0]]


REFUSED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "index": (lambda d: d["nodes"][0].update(mesh=7), "meshes.7"),
    "cycle": (lambda d: (d["nodes"][0].update(children=[0]), d.update(scenes=[{"nodes": [0]}])), "node 0"),
    "two parents": (lambda d: d["nodes"].extend([{"children": [0]}, {"children": [0]}]), "node 0"),
    "count": (lambda d: d["accessors"][0].update(count=300_000_000), "300,000,000"),
    "range of the view": (lambda d: d["bufferViews"][0].update(byteLength=10**12), "bufferViews.0"),
    "component type": (lambda d: d["accessors"][0].update(componentType=5130), "5130"),
    "text for a number": (lambda d: d["nodes"][0].update(scale=["1", 1, 1]), "nodes.0.scale"),
    "projection": (lambda d: d["nodes"][0].update(matrix=[*range(1, 17)]), "matrix"),
    "instances": (
        lambda d: d["nodes"][0].update(extensions={"EXT_mesh_gpu_instancing": {}}),
        "GPU instances",
    ),
    "weights": (lambda d: d["meshes"][0].update(weights=[0.0, 0.5]), "morph"),
    "glTF 1": (lambda d: d["asset"].update(version="1.0"), "1.0"),
    "required": (lambda d: d.update(extensionsRequired=["EXT_unheard_of"]), "EXT_unheard_of"),
    "draco": (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "Draco"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    change, says = REFUSED[name]
    builder = with_triangle()
    change(builder.document)
    with pytest.raises(InputError) as error:
        content_of(builder, tmp_path)
    assert says in error.value.message
    assert "\n" not in error.value.what
    assert str(tmp_path / "a.glb") in error.value.message


def test_missing_and_short_buffers_are_named(tmp_path: Path) -> None:
    path = with_triangle().write(tmp_path / "a.gltf")
    (tmp_path / "a.bin").write_bytes(b"\0" * 9)
    with pytest.raises(InputError, match="9 bytes of 36") as error:
        read_mesh_content(path)
    assert error.value.where == str(tmp_path / "a.bin")
    path.write_text(path.read_text().replace("a.bin", "https://example.org/a.bin"))
    with pytest.raises(InputError, match="https"):
        read_mesh_content(path)


def test_more_triangles_than_fit_are_refused_before_they_are_placed(tmp_path: Path) -> None:
    """5000 triangles at 5000 places."""
    builder = GltfBuilder()
    corners = builder.accessor(np.tile(np.arange(3, dtype=np.uint8), 5000))
    mesh = builder.mesh(TRIANGLE, None, more={"indices": corners})
    for _ in range(5000):
        builder.node(mesh)
    with pytest.raises(InputError, match="25,000,000 triangles"):
        content_of(builder, tmp_path)
