"""glTF 2.0 and GLB, written from the specification, with the values that it defines."""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mutations.case import F64, Case, Draws, Look, encoded, linear, patch, quarters

_TYPES = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
_LARGEST = {"f": 1.0, "B": 255.0, "H": 65535.0}
_WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
# Properties of materials that a tile uses in part or not at all, and words of the warning.
_OPTIONAL: tuple[tuple[dict[str, Any], str], ...] = (
    ({"extensions": {"KHR_materials_transmission": {"transmissionFactor": 1.0}}}, "transmission"),
    ({"extensions": {"KHR_materials_unlit": {}}}, "unlit"),
    ({"extensions": {"KHR_materials_anisotropy": {"anisotropyStrength": 0.9}}}, "anisotropy"),
    ({"extensions": {"KHR_materials_pbrSpecularGlossiness": {"glossinessFactor": 0}}}, "Glossiness"),
    ({"emissiveFactor": [1.0, 0.5, 0.0]}, "emissi"),
    ({"normalTexture": {"index": 0}}, "normal"),
)


class Writer:
    """The JSON and the buffer of a file."""

    def __init__(self) -> None:
        self.data = b""
        self.document: dict[str, list[Any]] = {
            name: [] for name in ("bufferViews", "accessors", "images", "textures")
        }

    def view(self, data: bytes, **more: int) -> int:
        """Number of a new buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        views = self.document["bufferViews"]
        views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(views) - 1

    def accessor(self, array: Any, kind: str, pad: int = 0) -> int:
        """Number of a new accessor of (n, k) numbers, normalized from [0, 1] where they are floats for a type
        of integers; `pad` bytes follow each element."""
        numbers = np.asarray(array)
        normalized = kind in "BH" and numbers.dtype.kind == "f"
        numbers = np.round(numbers * _LARGEST[kind]) if normalized else numbers
        numbers = numbers.reshape(len(numbers), -1).astype("<u4" if kind == "I" else f"<{kind}")
        size = numbers.shape[1] * numbers.itemsize
        pad += -size % 4 if numbers.shape[1] > 1 else 0
        rows = b"".join(row.tobytes() + b"\x5a" * pad for row in numbers)
        entry: dict[str, Any] = {"bufferView": self.view(rows, **({"byteStride": size + pad} if pad else {}))}
        entry |= {"componentType": _TYPES[kind], "count": len(numbers), "normalized": normalized}
        entry["type"] = ("SCALAR", "VEC2", "VEC3", "VEC4")[numbers.shape[1] - 1]
        if not normalized:
            entry |= {"min": numbers.min(axis=0).tolist(), "max": numbers.max(axis=0).tolist()}
        self.document["accessors"].append(entry)
        return len(self.document["accessors"]) - 1

    def texture(self, image: bytes, kind: str = "png") -> int:
        """Number of a new texture."""
        self.document["images"].append({"bufferView": self.view(image), "mimeType": f"image/{kind}"})
        self.document["textures"].append({"source": len(self.document["images"]) - 1})
        return len(self.document["textures"]) - 1


def make(d: Draws, folder: Path) -> Case:
    """A bumpy tile of one mesh with random features; y is up in the file."""
    w, (vertices, faces) = Writer(), patch(d.rng)
    look = Look(vertices, faces, (vertices[:, :2] * d.pick((1.0, 1.0, 2.5)) - d.pick((0.0, 0.75))))
    used, required = set[str](), list[str]()
    node: dict[str, Any] = {"mesh": 0}
    placed = vertices[:, [0, 2, 1]] * (1, 1, -1)
    if d.chance(0.15, "quantized positions"):
        node["scale"] = [1 / 30000.0] * 3
        stored = np.round(placed * 30000.0).astype(int)
        look.vertices = (stored * (1, 1, -1))[:, [0, 2, 1]] / 30000.0
        required.append("KHR_mesh_quantization")
        attributes = {"POSITION": w.accessor(stored, "h")}
    else:
        stored = _moved(placed, node, d) if d.chance(0.4) else placed
        attributes = {"POSITION": w.accessor(stored, "f", d.pick((0, 0, 8)))}
    number = d.pick((0, 0, 0, 1, 2), "TEXCOORD")
    for other in range(number):
        attributes[f"TEXCOORD_{other}"] = w.accessor(d.rng.uniform(0, 1, (len(vertices), 2)), "f")
    look.uv = look.uv * (1, -1) + (0, 1)  # v is down in files
    kind = d.pick("fBH", "coordinates of type") if look.uv.min() >= 0 and look.uv.max() <= 1 else "f"
    attributes[f"TEXCOORD_{number}"] = w.accessor(look.uv, kind, d.pick((0, 0, 4)))
    if kind != "f":
        look.uv = np.round(look.uv * _LARGEST[kind]) / _LARGEST[kind]

    pbr: dict[str, Any] = {}
    material: dict[str, Any] = {"pbrMetallicRoughness": pbr}
    rough, metal = 1.0, 1.0
    if d.chance(0.6):
        look.factor = np.array([d.between(0, 1), d.between(0, 0.01), d.between(0, 1)])
        pbr["baseColorFactor"] = [*look.factor, 1.0]
    if d.chance(0.6):
        rough = pbr["roughnessFactor"] = d.between(0.1, 1)
    if d.chance(0.7):
        metal = pbr["metallicFactor"] = d.pick((0.0, d.between(0, 1)))
    if d.chance(0.7):
        kind = d.pick(("png", "png", "jpeg"), "image")
        image = encoded(quarters(d.rng), kind.upper())
        look.texture = linear(np.asarray(Image.open(io.BytesIO(image))) / 255.0)
        info = pbr["baseColorTexture"] = {"index": w.texture(image, kind), "texCoord": number}
        if d.chance(0.3):
            look.wrap = (d.pick(_WRAPS, "u"), d.pick(_WRAPS, "v"))
            look.nearest = d.chance(0.3, "nearest")
            sampler = {"wrapS": _WRAPS[look.wrap[0]], "wrapT": _WRAPS[look.wrap[1]]}
            w.document["samplers"] = [sampler | ({"magFilter": 9728} if look.nearest else {})]
            w.document["textures"][0]["sampler"] = 0
        moved = np.eye(3)
        if d.chance(0.35, "KHR_texture_transform"):
            used.add("KHR_texture_transform")
            offset, angle = d.rng.uniform(-1, 1, 2).round(2), d.pick((0.0, 0.0, d.between(-2, 2)))
            scale = d.rng.uniform(0.4, 3, 2).round(2) * d.pick((1, 1, -1))
            placing = {"offset": offset.tolist(), "rotation": angle, "scale": scale.tolist()}
            info["extensions"] = {"KHR_texture_transform": placing}
            # The extension's matrices: translation, rotation, scale.
            c, s = np.cos(angle), np.sin(angle)
            moved[:2] = np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])
        look.to_uv = np.array([[1, 0, 0], [0, -1, 1]]) @ moved
    if d.chance(0.25, "metallicRoughnessTexture"):
        gloss = d.rng.integers(30, 255, 3).astype(np.uint8)
        index = w.texture(encoded(np.tile(gloss, (4, 4, 1))))
        pbr["metallicRoughnessTexture"] = {"index": index, "texCoord": number}
        rough, metal = rough * gloss[1] / 255, metal * gloss[2] / 255
    if d.chance(0.25):
        count = d.pick((1, len(vertices)), "COLOR_0")
        colors = d.rng.uniform(0, 1, (count, 3)) * np.ones((len(vertices), 1))
        kind = d.pick("fBH", "of type")
        attributes["COLOR_0"] = w.accessor(colors, kind)
        look.colors = colors if kind == "f" else np.round(colors * _LARGEST[kind]) / _LARGEST[kind]
    look.more = {"roughness": rough, "metallic": metal}
    tell: tuple[str, ...] = ()
    if d.chance(0.3):
        more, word = d.pick(_OPTIONAL)
        material |= {} if word == "normal" and look.texture is None else more
        used |= material.get("extensions", {}).keys()
        tell = (word,) if more.keys() <= material.keys() else ()
        d.words.append(f"with {word}")
    elif d.chance(0.1):
        material["alphaMode"] = d.pick(("BLEND", "MASK"), "alphaMode")
        pbr["baseColorFactor"] = [*look.factor, 0.25]
        look.more["opacity"] = 0.25 if material["alphaMode"] == "BLEND" else 0.0
        tell = ("alpha", "transparent", "opacity")
    primitive: dict[str, Any] = {"attributes": attributes, "material": 0}
    if d.chance(0.1, "no material"):
        del primitive["material"]
        look.factor, look.texture, tell, look.more = np.ones(3), None, (), {"roughness": 1.0, "metallic": 1.0}

    how = d.pick(("list", "list", "list", "fans", "strips"), "triangles:")
    if how == "list":
        primitives = [primitive | {"indices": w.accessor(faces.ravel(), d.pick("BHI"))}]
    else:
        mode = {"mode": 6 if how == "fans" else 5}
        primitives = [primitive | mode | {"indices": w.accessor(face, "H")} for face in faces]
    if d.chance(0.15, "lines"):
        primitives.append({"attributes": attributes, "mode": 1})
        tell = tell or ("lines", "triangles")
    second = d.chance(0.1, "two scenes")
    refused = d.chance(0.08, "unknown required extension")
    required += ["EXT_unheard_of"] * refused
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": int(second),
        "scenes": [{"nodes": [1, 0]}] * second + [{"nodes": [0]}],
        "nodes": [node] + [{"mesh": 0, "translation": [3, 3, 3]}] * second,
        "meshes": [{"primitives": primitives}],
        "materials": [material],
        "extensionsUsed": sorted(used | set(required)),
        "extensionsRequired": required,
        **w.document,
    }
    document = {name: value for name, value in document.items() if value != []}
    if d.chance(0.2) and "material" in primitive:
        refused = True
        _break(document, d)
    path = _write(document, w.data, folder, d)
    return Case(path, look.is_read_as, refused, tell, "opacity" in look.more, not refused and not tell)


def _moved(placed: F64, node: dict[str, Any], d: Draws) -> F64:
    """Positions that a node of the scene brings back to their place."""
    scale = np.round(d.rng.uniform(0.3, 3, 3), 2) * d.pick(((1, 1, 1), (1, 1, 1), (-1, 1, -1), (1, -1, 1)))
    move = np.round(d.rng.uniform(-2, 2, 3), 2)
    stored = (placed - move) / scale
    if d.chance(0.5, "matrix"):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.diag(scale), move
        node["matrix"] = matrix.T.ravel().tolist()
        return stored
    # A quarter turn around x takes (x, y, z) to (x, -z, y).
    node |= {"translation": move.tolist(), "rotation": [2**-0.5, 0, 0, 2**-0.5]}
    node["scale"] = scale[[0, 2, 1]].tolist()
    return np.stack([stored[:, 0], stored[:, 2], -stored[:, 1]], axis=1)


def _break(document: dict[str, Any], d: Draws) -> None:
    """Make the document invalid where every reader must refuse."""
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    accessor = document["accessors"][attributes["POSITION"]]
    entry, key, values = d.pick(
        (
            (accessor, "count", (300_000_000, 1_000_000, -1, 10**18)),
            (accessor, "type", ("VEC9", 5, "SCALAR")),
            (document["bufferViews"][accessor["bufferView"]], "byteOffset", (10**9, -16, 10**15)),
            (attributes, "POSITION", (99, -1, "a", 10**30)),
            (document["nodes"][0], "children", ([0],)),
            (document, "buffers", ([{"byteLength": 10**12}],)),
            (document["materials"][0]["pbrMetallicRoughness"], "metallicFactor", (-0.5, [1], "x", np.nan)),
        )
    )
    entry[key] = d.pick(values, key)


def _write(document: dict[str, Any], data: bytes, folder: Path, d: Draws) -> Path:
    """As GLB, or as .gltf beside its buffer or with the buffer inside."""
    form = d.pick(("glb", "glb", "gltf", "data"), "as")
    buffer: dict[str, Any] = {"byteLength": len(data)}
    if form == "data":
        buffer["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    elif form == "gltf":
        (folder / "my buffer.bin").write_bytes(data)
        buffer["uri"] = "my%20buffer.bin"
    text = json.dumps({"buffers": [buffer]} | document).encode()
    path = folder / ("tile.glb" if form == "glb" else "tile.gltf")
    if form == "glb":
        text += b" " * (-len(text) % 4)
        data += b"\0" * (-len(data) % 4)
        text = struct.pack("<I4s", len(text), b"JSON") + text
        text += struct.pack("<I4s", len(data), b"BIN\0") + data
        text = struct.pack("<4sII", b"glTF", 2, 12 + len(text)) + text
    path.write_bytes(text)
    return path
