"""Small files that claim, repeat or unfold much: whoever reads them takes neither 30 s nor 2 GiB."""

from __future__ import annotations

import base64
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import Case, Rng, encoded
from mutations.textures import png

_MANY = 100_000
# Side of an image that compresses to less than 1 MB.
_WIDE = 11_000


def make(rng: Rng, folder: Path) -> Case:
    """One of :data:`_BOMBS`; any reading in time is right."""
    # The number of the input, so that all have their turn.
    seed: Any = rng.bit_generator.seed_seq
    name = list(_BOMBS)[seed.entropy[-1] % len(_BOMBS)]
    path = folder / name.split()[0].rstrip(":")
    content = _BOMBS[name]()
    if isinstance(content, dict):
        content = _gltf(content)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return Case(path, name, lambda _: True)


def _gltf(document: dict[str, Any]) -> str:
    """A triangle, with parts replaced."""
    data = np.array([[0, 0, 0], [1, 0, 0], [0, 0, -1]], "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    base = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
    }
    return json.dumps(base | document)


def _wide() -> bytes:
    """A black PNG of many pixels."""
    return encoded(np.zeros((_WIDE, _WIDE), np.uint8))


def _over() -> bytes:
    """A PNG that claims more pixels than are read."""
    small = png(np.zeros((4, 4, 1)), 0, 8)
    head = b"IHDR" + struct.pack(">II", 30_000, 30_000) + small[24:29]
    return small[:12] + head + struct.pack(">I", zlib.crc32(head)) + small[33:]


def _tiff() -> bytes:
    import tifffile

    stream = io.BytesIO()
    tifffile.imwrite(
        stream, np.zeros((_WIDE // 2, _WIDE // 2), "f4"), compression="deflate", rowsperstrip=256
    )
    return stream.getvalue()


def _zip(count: int, size: int) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(count):
            archive.writestr(
                f"{k:05d} tl{k % 90:03d} pl{k // 90:03d} tv000 pv000.png",
                bytes(size) or encoded(np.zeros((2, 2, 3), np.uint8)),
            )
    return stream.getvalue()


def _ply(head: str, body: bytes = b"") -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{head}end_header\n".encode() + body


_XYZ = "property float x\nproperty float y\nproperty float z\n"
_POINT = {"componentType": 5126, "type": "VEC3"}
_MESH = {"mesh": 0}
_GHOST = [{"children": [k + 1]} for k in range(_MANY)]
_POLYGON = "f " + " ".join(str(k + 1) for k in range(20_002))


def _textured() -> dict[str, Any]:
    uri = "data:image/png;base64," + base64.b64encode(_wide()).decode()
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
    return {
        "images": [{"uri": uri}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [_POINT | {"bufferView": 0, "count": 3, "type": t} for t in ("VEC3", "VEC2")],
    }


def _sparse() -> dict[str, Any]:
    indices = {"bufferView": 0, "componentType": 5121}
    few = {"count": 1, "indices": indices, "values": {"bufferView": 0}}
    return {"accessors": [_POINT | {"count": 300_000_000, "sparse": few}]}


def _many(count: int) -> dict[str, Any]:
    nodes = [{"mesh": 0, "translation": [k % 300, k // 300, 0]} for k in range(count)]
    return {"nodes": nodes, "scenes": [{"nodes": list(range(count))}]}


def _bcc(count: int) -> bytes:
    head = struct.pack("<3sBccBBQQ40s", b"BCC", 0x44, b"C", b"0", 3, 2, count, 4 * count, b"")
    return head + b"".join(struct.pack("<i12f", 4, *np.arange(12) + k % 97) for k in range(count))


def _comb(wave: Callable[[int], float]) -> str:
    rows = "".join(f"v {k / 1e4:.4f} {wave(k):.3f} 0\n" for k in range(20_000))
    return rows + "v 2 -1 0\nv 0 -1 0\n" + _POLYGON


def _lines(count: int, points: int) -> str:
    runs = (
        "".join(f"{k % 100 + j * 1e-3:.3f} {k // 100 + j % 2} 0 0.01\n" for j in range(points))
        for k in range(count)
    )
    return "\n".join(runs)


_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
_HEAD = f"element vertex 3\n{_XYZ}element face"
_BOMBS: dict[str, Callable[[], Any]] = {
    "chain.gltf of 100 000 nodes": lambda: {"nodes": [*_GHOST, _MESH]},
    "siblings.gltf: 30 000 of one mesh": lambda: _many(30_000),
    "doubling.gltf: each node twice the next": lambda: {
        "nodes": [{"children": [k + 1, k + 1]} for k in range(60)] + [_MESH]
    },
    "deep.gltf with nested extras": lambda: _gltf({"extras": 0}).replace(
        '"extras": 0', '"extras": ' + "[" * _MANY + "]" * _MANY
    ),
    "count.gltf of 3e8": lambda: {"accessors": [_POINT | {"count": 300_000_000}]},
    "sparse.gltf of 3e8": _sparse,
    "primitives.gltf of one accessor": lambda: {
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * 20_000}]
    },
    "image.gltf of 11 000 x 11 000": _textured,
    "polygon.obj of 20 000 corners": lambda: _comb(lambda k: k * (20_000 - k) / 1e8),
    "comb.obj of 20 000 teeth": lambda: _comb(lambda k: k % 2 + (k % 7) / 10),
    "faces.obj of one triangle": lambda: _TRIANGLE + "f 1 2 3\n" * 120_000,
    "groups.obj": lambda: _TRIANGLE + "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(30_000)),
    "faces.ply of 3e8": lambda: _ply(
        f"{_HEAD} 300000000\nproperty list uchar int vertex_indices\n", bytes(100)
    ),
    "vertices.ply of 3e8": lambda: _ply(f"element vertex 300000000\n{_XYZ}", bytes(100)),
    "list.ply of 3e8": lambda: _ply(
        f"{_HEAD} 1\nproperty list uint int vertex_indices\n", bytes(36) + struct.pack("<I", 1 << 28)
    ),
    "empty.ply: elements without properties": lambda: _ply(
        "element ghost 2000000000\nelement vertex 3\n" + _XYZ, bytes(36)
    ),
    "wide.png of 11 000 x 11 000": _wide,
    "over.png of 30 000 x 30 000": _over,
    "wide.tif of floats": _tiff,
    "many.curves": lambda: _lines(18_000, 4),
    "long.curves": lambda: _lines(1, 30_000),
    "many.bcc": lambda: _bcc(15_000),
    "far.curves: a fiber over 10^7 periods": lambda: "0 0 0 1\n1 0 0 1\n0 1e-7 0 1\n1 1e-7 0 1\n0 0 0 1\n",
    "deep.yaml": lambda: "height: " + "[" * 500_000,
    "deeper.yaml: blocks": lambda: "".join(" " * k + "a:\n" for k in range(700)),
    "weave.yaml of 300 x 300 crossings": lambda: "weave: |\n" + ("  " + "X." * 150 + "\n") * 300,
    "yarns.yaml of many fibers": lambda: "weave: plain\nrepeat: 64\nyarn: {fibers: 100000}\n",
    "members.zip: 8 000 photographs": lambda: _zip(8_000, 0),
    "zeros.zip: a member of 0.9 GB": lambda: _zip(1, 900_000_000),
}
COUNT = len(_BOMBS)
