"""Small files that claim, repeat or unfold much: whoever reads them takes neither 30 s nor 2 GiB."""

from __future__ import annotations

import base64
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import Case, Draws, encoded

# Side of an image that compresses to less than 1 MB.
_WIDE = 11_000


def make(d: Draws, folder: Path) -> Case:
    """One of :data:`BOMBS`; any reading in time is right."""
    name, content = list(BOMBS.items())[d.number % len(BOMBS)]
    path = folder / name.split()[0].rstrip(":")
    data = content()
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    d.words.append(name)
    return Case(path, lambda _: True)


def _gltf(**parts: Any) -> str:
    """A triangle, with parts replaced."""
    data = np.array([[0, 0, 0], [1, 0, 0], [0, 0, -1]], "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    base = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [_POINT | {"bufferView": 0, "count": 3}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
    }
    return json.dumps(base | parts)


def _textured() -> str:
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}
    return _gltf(
        images=[{"uri": "data:image/png;base64," + base64.b64encode(_wide()).decode()}],
        textures=[{"source": 0}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        meshes=[{"primitives": [primitive]}],
        accessors=[_POINT | {"bufferView": 0, "count": 3, "type": t} for t in ("VEC3", "VEC2")],
    )


def _siblings(count: int) -> str:
    nodes = [{"mesh": 0, "translation": [k % 300, k // 300, 0]} for k in range(count)]
    return _gltf(nodes=nodes, scenes=[{"nodes": list(range(count))}])


def _wide() -> bytes:
    return encoded(np.zeros((_WIDE, _WIDE), np.uint8))


def _tiff() -> bytes:
    import tifffile

    stream, zeros = io.BytesIO(), np.zeros((_WIDE // 2, _WIDE // 2), "f4")
    tifffile.imwrite(stream, zeros, compression="deflate", rowsperstrip=256)
    return stream.getvalue()


def _zip(count: int, content: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for k in range(count):
            archive.writestr(f"{k:05d} tl{k % 90:03d} pl{k // 90:03d} tv000 pv000.png", content)
    return stream.getvalue()


def _polygon(count: int) -> str:
    rows = "".join(f"v {k / count:.6f} {k % 2 + k % 7 / 10:.3f} 0\n" for k in range(count))
    return rows + "v 1 -1 0\nv 0 -1 0\nf " + " ".join(str(k + 1) for k in range(count + 2))


def _curves(count: int, points: int) -> str:
    at = "{:.3f} {} 0 0.01\n"
    runs = ([at.format(k % 100 + j * 1e-3, k // 100 + j % 2) for j in range(points)] for k in range(count))
    return "\n".join("".join(run) for run in runs)


_POINT = {"componentType": 5126, "type": "VEC3"}
_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
BOMBS: dict[str, Callable[[], str | bytes]] = {
    "chain.gltf of 100 000 nodes": lambda: _gltf(
        nodes=[*({"children": [k + 1]} for k in range(100_000)), {"mesh": 0}]
    ),
    "siblings.gltf: 30 000 of one mesh": lambda: _siblings(30_000),
    "deep.gltf": lambda: _gltf(extras=0).replace('"extras": 0', '"extras": ' + "[" * 100_000 + "]" * 100_000),
    "primitives.gltf of one accessor": lambda: _gltf(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}] * 20_000}]
    ),
    "image.gltf of 11 000 x 11 000": _textured,
    "polygon.obj of 20 000 corners": lambda: _polygon(20_000),
    "groups.obj": lambda: _TRIANGLE + "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(30_000)),
    "wide.png of 11 000 x 11 000": _wide,
    "wide.tif of floats": _tiff,
    "many.curves": lambda: _curves(18_000, 4),
    "far.curves: a fiber over 10^7 periods": lambda: "0 0 0 1\n1 0 0 1\n0 1e-7 0 1\n1 1e-7 0 1\n0 0 0 1\n",
    "blocks.yaml": lambda: "".join(" " * k + "a:\n" for k in range(700)),
    "weave.yaml of 300 x 300 crossings": lambda: "weave: |\n" + ("  " + "X." * 150 + "\n") * 300,
    "yarns.yaml of many fibers": lambda: "weave: plain\nrepeat: 64\nyarn: {fibers: 100000}\n",
    "members.zip: 8 000 photographs": lambda: _zip(8_000, encoded(np.zeros((2, 2, 3), np.uint8))),
    "zeros.zip: a member of 0.9 GB": lambda: _zip(1, bytes(900_000_000)),
}
