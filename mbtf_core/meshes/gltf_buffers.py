"""Container, buffers and accessors of glTF 2.0: JSON with files beside it, or one binary file."""

from __future__ import annotations

import base64
import binascii
import re
from codecs import BOM_UTF8
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from mbtf_core.config.settings import build
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import parse_json
from mbtf_core.meshes.companions import Companions
from mbtf_core.meshes.content import F64, MOST_TRIANGLES, read_bytes
from mbtf_core.meshes.gltf_schema import GltfAccessor, GltfDocument

Bytes = NDArray[np.uint8]
T = TypeVar("T")

_MAGIC, _JSON, _BINARY = b"glTF", 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
FLOAT = 5126
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# Elements of an accessor without data of its own, which its count alone would allocate.
_MOST_ELEMENTS = 3 * MOST_TRIANGLES
_DATA_URI = re.compile(r"data:[^,]*?(;base64)?,", re.IGNORECASE)
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
_NO_MESHOPT = "export it without meshopt compression"
# What to do about extensions that change how the data are stored.
HINTS = {
    "KHR_draco_mesh_compression": "export it without Draco compression",
    "EXT_meshopt_compression": _NO_MESHOPT,
    "KHR_meshopt_compression": _NO_MESHOPT,
    "KHR_texture_basisu": "export it with PNG or JPEG textures in place of KTX2",
    "EXT_texture_webp": "export it with PNG or JPEG textures in place of WebP",
    "EXT_texture_avif": "export it with PNG or JPEG textures in place of AVIF",
    "EXT_mesh_gpu_instancing": "export the instances as nodes",
    "MSFT_texture_dds": "export it with PNG or JPEG textures in place of DDS",
}
# Those that are read.
READ = {
    "KHR_materials_clearcoat",
    "KHR_materials_ior",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}


class GltfFile(Companions):
    """A glTF document, ``.gltf`` or ``.glb`` by its content, and its data, read on demand.

    Attributes
    ----------
    document : its parts that are read
    extensions : names of all extensions that it uses, sorted

    Raises
    ------
    InputError : it is no glTF 2.0, it is damaged, or it requires an extension that is not read
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        content = read_bytes(path)
        text, self._chunk = _chunks(content, path) if content.startswith(_MAGIC) else (content, None)
        data = parse_json(text.removeprefix(BOM_UTF8), path)
        asset = data.get("asset")
        version = str(asset.get("version")) if isinstance(asset, dict) else "without a version"
        if version.partition(".")[0] != "2":
            raise InputError(f"is glTF {version}; 2.0 is read", where=path, hint="export it as glTF 2.0")
        required = data.get("extensionsRequired")
        lacking = [str(name) for name in required if name not in READ] if isinstance(required, list) else []
        if lacking:
            hints = dict.fromkeys(HINTS.get(name, f"export it without {name}") for name in lacking)
            what = f"requires {', '.join(lacking)}, which is not read"
            raise InputError(what, where=path, hint="; ".join(hints))
        self.document = build(GltfDocument, data, source=str(path))
        self.extensions = sorted(set(_extensions(data)))
        self._buffers: dict[int, Bytes] = {}

    def entry(self, items: Sequence[T], index: int, kind: str) -> T:
        """An item of one of the document's lists."""
        if index >= len(items):
            raise InputError(f"names {kind}.{index}, of {len(items)}", where=self.path)
        return items[index]

    def view(self, index: int) -> tuple[Bytes, int]:
        """(bytes, stride; 0 for none) of a buffer view."""
        view = self.entry(self.document.bufferViews, index, "bufferViews")
        data = self._buffer(view.buffer)
        end = view.byteOffset + view.byteLength
        if end > len(data):
            what = f"'bufferViews.{index}' ends at byte {end} of buffer {view.buffer}, which has {len(data)}"
            raise InputError(what, where=self.path)
        return data[view.byteOffset : end], view.byteStride

    def vectors(self, index: int, widths: Sequence[int], what: str) -> F64:
        """Numbers (n, width) of an accessor, integers divided by the largest if it says so."""
        accessor, values = self._elements(index, widths, what)
        out = values.astype(np.float64)
        if accessor.normalized and values.dtype.kind != "f":
            out /= np.iinfo(values.dtype).max
            np.maximum(out, -1.0, out=out)
        return out

    def indices(self, index: int) -> NDArray[np.int64]:
        """Integers (n,) of an accessor."""
        _, values = self._elements(index, (1,), "indices")
        if values.dtype.kind != "u":
            raise InputError(f"'accessors.{index}' holds {values.dtype} in place of indices", where=self.path)
        return values[:, 0].astype(np.int64)

    def of_uri(self, uri: str) -> tuple[bytes, Path | None]:
        """(content, file) of a URI, None for data within it; an InputError where the file is missing or
        cannot be read, or the URI is none of a file."""
        if match := _DATA_URI.match(uri):
            try:
                if match[1] is None:
                    raise binascii.Error("not base64")
                return base64.b64decode(uri[match.end() :], validate=True), None
            except binascii.Error as error:
                raise InputError(f"has a damaged data URI ({error})", where=self.path) from None
        if _SCHEME.match(uri) and not re.match(r"[A-Za-z]:[\\/]", uri):
            what = f"names '{uri[:80]}', which is no file beside it"
            raise InputError(what, where=self.path, hint="save it beside the file and name it there")
        try:
            path = self.find(unquote(uri))
        except InputError:
            # Some programs forget to encode names.
            path = self.find(uri)
        return read_bytes(path), path

    def _buffer(self, index: int) -> Bytes:
        if index not in self._buffers:
            buffer = self.entry(self.document.buffers, index, "buffers")
            where, content = self.path, self._chunk if index == 0 else None
            if buffer.uri is not None:
                content, path = self.of_uri(buffer.uri)
                where = path or where
            if content is None:
                hint = _NO_MESHOPT if any("meshopt" in name for name in self.extensions) else ""
                raise InputError(f"'buffers.{index}' has no data", where=self.path, hint=hint)
            if len(content) < buffer.byteLength:
                what = f"is cut short: buffer {index} has {len(content)} bytes of {buffer.byteLength}"
                raise InputError(what, where=where)
            self._buffers[index] = np.frombuffer(content, np.uint8, buffer.byteLength)
        return self._buffers[index]

    def _elements(self, index: int, widths: Sequence[int], what: str) -> tuple[GltfAccessor, NDArray[Any]]:
        """An accessor and its elements (n, width) as stored, those of a sparse one put in."""
        accessor = self.entry(self.document.accessors, index, "accessors")
        name, width = f"'accessors.{index}'", _WIDTHS.get(accessor.type, 0)
        if width not in widths:
            raise InputError(f"{name} holds {accessor.type} in place of {what}", where=self.path)
        kind, count = self._kind(accessor.componentType, name), accessor.count
        if accessor.bufferView is not None:
            values = self._strided(accessor.bufferView, accessor.byteOffset, kind, (count, width), name)
        elif count > _MOST_ELEMENTS:
            raise InputError(f"{name} has {count:,} elements, more than {_MOST_ELEMENTS:,}", where=self.path)
        else:
            values = np.zeros((count, width), kind)
        if (sparse := accessor.sparse) is not None:
            at, kinds = sparse.indices, self._kind(sparse.indices.componentType, name)
            places = self._strided(at.bufferView, at.byteOffset, kinds, (sparse.count, 1), name)[:, 0]
            new = sparse.values
            given = self._strided(new.bufferView, new.byteOffset, kind, (sparse.count, width), name)
            if kinds.kind != "u" or int(places.max()) >= count:
                raise InputError(f"{name} replaces elements that it lacks", where=self.path)
            values = values.copy()
            values[places] = given
        return accessor, values

    def _kind(self, component: int, name: str) -> np.dtype[Any]:
        if component not in _COMPONENTS:
            raise InputError(f"{name} has the unknown component type {component}", where=self.path)
        return np.dtype(_COMPONENTS[component])

    def _strided(
        self, view: int, offset: int, kind: np.dtype[Any], shape: tuple[int, int], name: str
    ) -> NDArray[Any]:
        """Elements of a buffer view, not copied."""
        data, stride = self.view(view)
        size = kind.itemsize * shape[1]
        stride = stride or size
        if stride < size or offset + (shape[0] - 1) * stride + size > len(data):
            what = f"{name} claims {shape[0]:,} elements, more than 'bufferViews.{view}' holds"
            raise InputError(what, where=self.path)
        return np.ndarray(shape, kind, data, offset, (stride, kind.itemsize))


def _chunks(content: bytes, path: Path) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a GLB file."""
    version, length = (int.from_bytes(content[at : at + 4], "little") for at in (4, 8))
    if version != 2:
        raise InputError(f"is binary glTF {version}; 2 is read", where=path, hint="export it as glTF 2.0")
    if len(content) < max(length, 20):
        raise InputError(f"is cut short: it has {len(content)} bytes of {length}", where=path)
    found: dict[int, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = (int.from_bytes(content[k : k + 4], "little") for k in (at, at + 4))
        if at + 8 + size > length:
            raise InputError("is damaged: a chunk is longer than the file", where=path)
        found.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON not in found:
        raise InputError("is damaged: it has no JSON chunk", where=path)
    return found[_JSON], found.get(_BINARY)


def _extensions(data: Any) -> Iterator[str]:
    """Names of the extensions of an object and of all that it contains."""
    waiting = [data]
    while waiting:
        node = waiting.pop()
        if isinstance(node, dict):
            extensions = node.get("extensions")
            yield from extensions if isinstance(extensions, dict) else ()
            # What programs store for themselves.
            waiting += [value for key, value in node.items() if key != "extras"]
        elif isinstance(node, list):
            waiting += node
