"""Small glTF files, assembled by hand."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
# Corners of the unit square in glTF's axes, y up, and their texture coordinates, v down.
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 0, -1], [0, 0, -1]], np.float32)
SQUARE_UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
TWO_TRIANGLES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


def png(pixels: NDArray[Any]) -> bytes:
    """PNG file of 8- or 16-bit codes."""
    if pixels.dtype == np.uint16:
        return bytes(imagecodecs.png_encode(np.ascontiguousarray(pixels)))
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


class GltfBuilder:
    """A glTF document with one buffer."""

    def __init__(self) -> None:
        self.blob = bytearray()
        self.document: dict[str, Any] = {"asset": {"version": "2.0"}}

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Append an item to a list of the document; its index."""
        self.document.setdefault(kind, []).append(item)
        return len(self.document[kind]) - 1

    def view(self, content: bytes, **more: Any) -> int:
        """A buffer view."""
        self.blob += b"\0" * (-len(self.blob) % 4)
        start = len(self.blob)
        self.blob += content
        return self.add("bufferViews", {"buffer": 0, "byteOffset": start, "byteLength": len(content), **more})

    def accessor(self, values: ArrayLike, normalized: bool = False, **more: Any) -> int:
        """An accessor of an array (n,) or (n, width)."""
        array = np.ascontiguousarray(values)
        array = array.astype(np.float32) if array.dtype == np.float64 else array
        width = 1 if array.ndim == 1 else array.shape[1]
        item = {
            "bufferView": self.view(array.tobytes()),
            "componentType": COMPONENTS[array.dtype.str[1:]],
            "count": len(array),
            "type": TYPES[width],
            **({"normalized": True} if normalized else {}),
        }
        return self.add("accessors", {**item, **more})

    def texture(self, pixels: NDArray[Any], sampler: dict[str, Any] | None = None) -> int:
        """A texture of a PNG in the buffer."""
        image = self.add("images", {"bufferView": self.view(png(pixels)), "mimeType": "image/png"})
        more = {} if sampler is None else {"sampler": self.add("samplers", sampler)}
        return self.add("textures", {"source": image, **more})

    def material(self, base: dict[str, Any] | None = None, **more: Any) -> int:
        """A material."""
        return self.add("materials", {**({} if base is None else {"pbrMetallicRoughness": base}), **more})

    def mesh(
        self,
        positions: ArrayLike = SQUARE,
        indices: ArrayLike | None = TWO_TRIANGLES,
        *,
        material: int | None = None,
        mode: int | None = None,
        more: dict[str, Any] | None = None,
        **attributes: Any,
    ) -> int:
        """A mesh of one primitive; attributes are arrays, or indices of accessors."""
        given = {"POSITION": positions, **attributes}
        primitive: dict[str, Any] = {
            "attributes": {k: v if isinstance(v, int) else self.accessor(v) for k, v in given.items()},
            **({} if indices is None else {"indices": self.accessor(indices)}),
            **({} if material is None else {"material": material}),
            **({} if mode is None else {"mode": mode}),
            **(more or {}),
        }
        return self.add("meshes", {"primitives": [primitive]})

    def node(self, mesh: int | None = None, **more: Any) -> int:
        """A node."""
        return self.add("nodes", {**({} if mesh is None else {"mesh": mesh}), **more})

    def plate(self, material: int | None = None, **attributes: Any) -> GltfBuilder:
        """The unit square with texture coordinates, as a node."""
        given = {"TEXCOORD_0": SQUARE_UV, **attributes}
        self.node(self.mesh(material=material, **given))
        return self

    def finished(self, uri: str | None = None) -> dict[str, Any]:
        """The document with its scene and its buffer."""
        document = dict(self.document)
        if "scenes" not in document:
            nodes = document.get("nodes", [])
            below = {child for node in nodes for child in node.get("children", ())}
            document |= {"scenes": [{"nodes": [k for k in range(len(nodes)) if k not in below]}], "scene": 0}
        if self.blob:
            document["buffers"] = [{"byteLength": len(self.blob), **({"uri": uri} if uri else {})}]
        return document

    def glb(self) -> bytes:
        """The binary file."""
        text = json.dumps(self.finished()).encode()
        chunks = b""
        for kind, content, pad in ((b"JSON", text, b" "), (b"BIN\0", bytes(self.blob), b"\0")):
            content += pad * (-len(content) % 4)
            chunks += struct.pack("<I", len(content)) + kind + content
        return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks

    def write(self, path: Path) -> Path:
        """Write the binary file, or the text with ``NAME.bin`` beside it."""
        if path.suffix == ".gltf":
            path.with_suffix(".bin").write_bytes(bytes(self.blob))
            path.write_text(json.dumps(self.finished(f"{path.stem}.bin")))
        else:
            path.write_bytes(self.glb())
        return path
