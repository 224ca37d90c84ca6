"""Small files that claim, repeat or unfold much: whoever reads them takes neither 30 s nor 2 GiB."""

from __future__ import annotations

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
    if path.suffix in (".png", ".tif") and path.stat().st_size > 1_500_000:
        raise ValueError(f"{name} is no small file")
    return Case(path, name, lambda _: True)


def _gltf(document: dict[str, Any]) -> str:
    """A triangle, with parts replaced."""
    data = np.array([[0, 0, 0], [1, 0, 0], [0, 0, -1]], "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + __import__("base64").b64encode(data).decode()
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


def _gray(side: int = _WIDE) -> bytes:
    """A black PNG, line by line."""
    deflate = zlib.compressobj(9)
    lines = b"".join(deflate.compress(bytes(side + 1)) for _ in range(side)) + deflate.flush()
    return png(np.zeros((0, side, 1)), 0, 8).replace(struct.pack(">II", side, 0), struct.pack(">II", side, side)).replace(
        *_chunks(side, lines)
    )


def _chunks(side: int, lines: bytes) -> tuple[bytes, bytes]:
    """The head and empty data that :func:`mutations.textures.png` wrote, and those of `lines`."""
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    old = struct.pack(">I", 13) + b"IHDR" + head + struct.pack(">I", zlib.crc32(b"IHDR" + head[:4] + bytes(4) + head[8:]))
    return old + chunk(b"IDAT", zlib.compress(b"")), chunk(b"IHDR", head) + chunk(b"IDAT", lines)


def _tiff(kind: str) -> bytes:
    import io

    import tifffile

    stream = io.BytesIO()
    tifffile.imwrite(stream, np.zeros((_WIDE // 2, _WIDE // 2), kind), compression="deflate", rowsperstrip=256)
    return stream.getvalue()


def _zip(count: int, size: int) -> bytes:
    import io

    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(count):
            archive.writestr(f"{k:05d} tl{k % 90:03d} pl{k // 90:03d} tv000 pv000.png", bytes(size) or encoded(np.zeros((2, 2, 3), np.uint8)))
    return stream.getvalue()


def _ply(head: str, body: bytes = b"") -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{head}end_header\n".encode() + body


_XYZ = "property float x\nproperty float y\nproperty float z\n"
_BOMBS: dict[str, Callable[[], Any]] = {
    "chain.gltf of 100 000 nodes": lambda: {"nodes": [{"children": [k + 1]} for k in range(_MANY)] + [{"mesh": 0}]},
    "siblings.gltf: 100 000 of one mesh": lambda: {"nodes": [{"mesh": 0, "translation": [k % 300, k // 300, 0]} for k in range(_MANY // 3)], "scenes": [{"nodes": list(range(_MANY // 3))}]},
    "doubling.gltf: each node twice the next": lambda: {"nodes": [{"children": [k + 1, k + 1]} for k in range(60)] + [{"mesh": 0}]},
    "deep.gltf with nested extras": lambda: _gltf({}).replace('"asset": {', '"asset": {"extras": ' + "[" * _MANY + "]" * _MANY + ", "),
    "count.gltf of 3e8": lambda: {"accessors": [{"componentType": 5126, "count": 300_000_000, "type": "VEC3"}]},
    "sparse.gltf of 3e8": lambda: {"accessors": [{"componentType": 5126, "count": 300_000_000, "type": "VEC3", "sparse": {"count": 1, "indices": {"bufferView": 0, "componentType": 5121}, "values": {"bufferView": 0}}}]},
    "primitives.gltf: 100 000 of one accessor": lambda: {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}] * (_MANY // 5)}]},
    "instances.gltf": lambda: {"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 1}}}}], "extensionsUsed": ["EXT_mesh_gpu_instancing"], "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}, {"componentType": 5126, "count": 300_000_000, "type": "VEC3"}]},
    "image.gltf of 11 000 x 11 000": lambda: {"images": [{"uri": "data:image/png;base64," + __import__("base64").b64encode(_gray()).decode()}], "textures": [{"source": 0}], "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}], "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": t} for t in ("VEC3", "VEC2")]},
    "polygon.obj of 50 000 corners": lambda: "".join(f"v {np.cos(k / 7958):.6f} {np.sin(k / 7958):.6f} 0\n" for k in range(50_000)) + "f " + " ".join(map(str, range(1, 50_001))),
    "comb.obj: a bent polygon of 20 000 corners": lambda: "".join(f"v {k / 1e4:.4f} {k % 2 + (k % 7) / 10:.1f} 0\n" for k in range(20_000)) + "v 2 -1 0\nv 0 -1 0\nf " + " ".join(map(str, range(1, 20_003))),
    "star.obj: many faces of one vertex": lambda: "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3\n" * 120_000,
    "groups.obj of 30 000 materials": lambda: "v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(30_000)),
    "faces.ply of 3e8": lambda: _ply(f"element vertex 3\n{_XYZ}element face 300000000\nproperty list uchar int vertex_indices\n", bytes(100)),
    "vertices.ply of 3e8": lambda: _ply(f"element vertex 300000000\n{_XYZ}", bytes(100)),
    "list.ply of 3e8": lambda: _ply(f"element vertex 3\n{_XYZ}element face 1\nproperty list uint int vertex_indices\n", bytes(36) + struct.pack("<I", 300_000_000)),
    "empty.ply: elements without properties": lambda: _ply("element ghost 2000000000\nelement vertex 3\n" + _XYZ, bytes(36)),
    "wide.png of 11 000 x 11 000": _gray,
    "over.png of 30 000 x 30 000": lambda: _gray(30_000),
    "wide.tif of floats": lambda: _tiff("f4"),
    "wide8.tif": lambda: _tiff("u1"),
    "many.curves": lambda: "".join("".join(f"{k % 100} {k // 100} {j} 0.01\n" for j in range(4)) + "\n" for k in range(18_000)),
    "many.bcc": lambda: struct.pack("<3sBccBBQQ40s", b"BCC", 0x44, b"C", b"0", 3, 2, 15_000, 60_000, b"") + b"".join(struct.pack("<i12f", 4, *np.arange(12) + k % 97) for k in range(15_000)),
    "long.curves: one fiber of 30 000 points": lambda: "".join(f"{k * 1e-3:.3f} {np.sin(k * .1):.3f} 0 0.01\n" for k in range(30_000)),
    "far.curves: a fiber over 10^7 periods": lambda: "0 0 0 1\n1 0 0 1\n0 1e-7 0 1\n1 1e-7 0 1\n0 0 0 1\n",
    "deep.yaml": lambda: "height: " + "[" * 500_000,
    "deeper.yaml: blocks": lambda: "".join(" " * k + "a:\n" for k in range(1000)) + "height: h.png\n",
    "items.yaml": lambda: "height: h.png\nx: [" + "1," * 400_000 + "]\n",
    "weave.yaml of 300 x 300 crossings": lambda: "weave: |\n" + ("  " + "X." * 150 + "\n") * 300,
    "yarns.yaml of many fibers": lambda: "weave: plain\nrepeat: 64\nyarn: {fibers: 100000}\n",
    "members.zip: 20 000 photographs": lambda: _zip(8_000, 0),
    "zeros.zip: a member of 1 GB": lambda: _zip(1, 900_000_000),
}  # fmt: skip
