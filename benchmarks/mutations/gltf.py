"""glTF 2.0 and GLB, written from the specification, with the values that it defines."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from mutations.case import (
    F64,
    PLACES,
    Case,
    Draws,
    Rng,
    agree,
    damaged,
    encoded,
    hit,
    linear,
    looked_up,
    patch,
    quarters,
)

_TYPES = {"b": 5120, "B": 5121, "h": 5122, "H": 5123, "I": 5125, "f": 5126}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_WRAPS = {"repeat": 10497, "mirror": 33648, "clamp": 33071}
# Extensions of materials that are not used by a tile, or only in part: a warning, a refusal, or the effect.
_IGNORED: dict[str, dict[str, Any]] = {
    "KHR_materials_transmission": {"transmissionFactor": 1.0},
    "KHR_materials_unlit": {},
    "KHR_materials_iridescence": {"iridescenceFactor": 1.0},
    "KHR_materials_anisotropy": {"anisotropyStrength": 0.9},
    "KHR_materials_diffuse_transmission": {"diffuseTransmissionFactor": 0.8},
    "KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [1, 0, 0, 1]},
}


class Writer:
    """The JSON and the buffer of a file."""

    def __init__(self) -> None:
        self.data = b""
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, **more: Any) -> int:
        """Number of a new buffer view."""
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(data), **more})
        self.data += data
        return len(self.views) - 1

    def accessor(self, array: Any, kind: str, normalized: bool = False, pad: int = 0) -> int:
        """Number of a new accessor of (n, k) numbers, with `pad` bytes between its elements."""
        numbers = np.atleast_2d(np.asarray(array).T).T.astype(f"<{'u4' if kind == 'I' else kind}")
        size = numbers.shape[1] * numbers.itemsize
        pad += -size % 4 if kind != "I" and numbers.shape[1] > 1 else 0
        rows = b"".join(row.tobytes() + b"\x5a" * pad for row in numbers)
        view = self.view(rows, **({"byteStride": size + pad} if pad else {}))
        self.accessors.append(
            {"bufferView": view, "componentType": _TYPES[kind], "count": len(numbers)}
            | {"type": _SHAPES[numbers.shape[1]]}
            | ({"normalized": True} if normalized else {})
            | ({"min": numbers.min(0).tolist(), "max": numbers.max(0).tolist()} if kind == "f" else {})
        )
        return len(self.accessors) - 1


def make(rng: Rng, folder: Path) -> Case:
    """A bumpy tile of one mesh with random features; y is up in the file."""
    d, w = Draws(rng), Writer()
    vertices, faces = patch(rng)
    uv = vertices[:, :2] * d.pick((1.0, 1.0, 2.5)) - d.pick((0.0, 0.0, 0.75))
    used: set[str] = set()
    required: list[str] = []
    node: dict[str, Any] = {"mesh": 0}
    tell: tuple[str, ...] = ()

    # Positions: y up, the file's z is -y of the tile; quantized ones are scaled back by the node.
    placed = np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], axis=1)
    if d.chance(0.15, "quantized positions"):
        placed = np.round(placed * 30000.0)
        node["scale"] = [1 / 30000.0] * 3
        used.add("KHR_mesh_quantization")
        attributes = {"POSITION": w.accessor(placed, "h")}
        vertices = np.stack([placed[:, 0], -placed[:, 2], placed[:, 1]], axis=1) / 30000.0
    else:
        attributes = {"POSITION": w.accessor(placed, "f", pad=d.pick((0, 0, 8)))}
        if d.chance(0.4):
            _place(node, placed, w, attributes, d)
    coordinates = uv * (1, -1) + (0, 1)  # v is down in files
    sets = d.pick((0, 0, 0, 1, 2))
    for number in range(sets):
        attributes[f"TEXCOORD_{number}"] = w.accessor(rng.uniform(0, 1, uv.shape), "f")
    if coordinates.min() >= 0 and coordinates.max() <= 1 and d.chance(0.3, "quantized texture coordinates"):
        kind = d.pick("BH")
        most = {"B": 255, "H": 65535}[kind]
        coordinates = np.round(coordinates * most) / most
        attributes[f"TEXCOORD_{sets}"] = w.accessor(np.round(coordinates * most), kind, normalized=True)
    else:
        attributes[f"TEXCOORD_{sets}"] = w.accessor(coordinates, "f", pad=d.pick((0, 0, 4)))
    if sets:
        d.words.append(f"TEXCOORD_{sets}")

    # Reflectance.
    pbr: dict[str, Any] = {}
    factor, rough, metal = np.ones(3), 1.0, 1.0
    if d.chance(0.6):
        factor = np.array([d.number(0, 1), d.number(0, 0.01), d.number(0, 1)])
        pbr["baseColorFactor"] = [*factor, 1.0]
    if d.chance(0.6):
        rough = pbr["roughnessFactor"] = d.number(0.1, 1)
    if d.chance(0.7):
        metal = pbr["metallicFactor"] = d.pick((0.0, d.number(0, 1)))
    material: dict[str, Any] = {"pbrMetallicRoughness": pbr}
    images, textures, samplers = [], [], []
    texture, wrap, nearest, to_uv = None, ("repeat", "repeat"), False, np.eye(2, 3)
    if d.chance(0.7):
        codes = quarters(rng)
        kind = d.pick(("png", "png", "jpeg"))
        content = encoded(
            codes, kind.upper(), **({"quality": 100, "subsampling": 0} if kind == "jpeg" else {})
        )
        if kind == "jpeg":
            import io

            from PIL import Image

            codes = np.asarray(Image.open(io.BytesIO(content)))
        texture = linear(codes / 255.0)
        images.append({"bufferView": w.view(content), "mimeType": f"image/{kind}"})
        textures.append({"source": 0})
        info: dict[str, Any] = {"index": 0, "texCoord": sets} if sets else {"index": 0}
        if d.chance(0.3):
            wrap = (d.pick(_WRAPS), d.pick(_WRAPS))
            nearest = d.chance(0.3)
            samplers.append(
                {"wrapS": _WRAPS[wrap[0]], "wrapT": _WRAPS[wrap[1]]}
                | ({"magFilter": 9728} if nearest else {})
            )
            textures[0]["sampler"] = 0
            d.words.append(f"sampler {wrap} {'nearest' if nearest else ''}")
        if d.chance(0.35, "KHR_texture_transform"):
            offset, angle = rng.uniform(-1, 1, 2).round(2), d.pick((0.0, 0.0, d.number(-2, 2)))
            scale = rng.uniform(0.4, 3, 2).round(2) * d.pick((1, 1, -1))
            info["extensions"] = {
                "KHR_texture_transform": {
                    "offset": offset.tolist(),
                    "rotation": angle,
                    "scale": scale.tolist(),
                }
            }
            used.add("KHR_texture_transform")
            # The extension's matrices: translation, rotation, scale.
            c, s = np.cos(angle), np.sin(angle)
            to_uv = np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])
        pbr["baseColorTexture"] = info
    gloss, opacity = None, dict[str, float]()
    if d.chance(0.25, "metallicRoughnessTexture"):
        gloss = rng.integers(30, 255, 3).astype(np.uint8)
        images.append({"bufferView": w.view(encoded(np.tile(gloss, (4, 4, 1)))), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1})
        pbr["metallicRoughnessTexture"] = {"index": len(textures) - 1, "texCoord": sets}
        rough, metal = rough * gloss[1] / 255, metal * gloss[2] / 255
    colors = np.ones((len(vertices), 3))
    if d.chance(0.25):
        varying = d.chance(0.5)
        colors = rng.uniform(0, 1, (len(vertices) if varying else 1, 3)) * np.ones((len(vertices), 1))
        kind = d.pick("fBH", f"{'varying' if varying else 'uniform'} COLOR_0 of type")
        largest = {"f": 1.0, "B": 255.0, "H": 65535.0}[kind]
        exact = np.round(colors * largest) / largest
        colors = colors.astype(np.float32).astype(float) if kind == "f" else exact
        attributes["COLOR_0"] = w.accessor(colors * largest, kind, normalized=kind != "f")
    if d.chance(0.2):
        name = d.pick(_IGNORED, "extension")
        material["extensions"] = {name: _IGNORED[name]}
        used.add(name)
        tell = (name, name.removeprefix("KHR_materials_"))
    elif d.chance(0.1, "normalTexture"):
        images.append({"bufferView": w.view(encoded(quarters(rng))), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1})
        material["normalTexture"] = {"index": len(textures) - 1}
        tell = ("normal",)
    elif d.chance(0.1, "emissive"):
        material["emissiveFactor"] = [1.0, 0.5, 0.0]
        tell = ("emissive", "emission")
    elif d.chance(0.1):
        mode = d.pick(("BLEND", "MASK"), "alphaMode")
        pbr["baseColorFactor"] = [*factor, 0.25]
        material["alphaMode"] = mode
        opacity = {"opacity": 0.25 if mode == "BLEND" else 0.0}
        tell = ("alpha", "transparent", "opacity")
    if d.chance(0.1, "no material"):
        material, texture, gloss, opacity, tell = {}, None, None, {}, ()
        factor, rough, metal = np.ones(3), 1.0, 1.0

    # Topology.
    primitive: dict[str, Any] = {"attributes": attributes}
    if material:
        primitive["material"] = 0
    how = d.pick(("list", "list", "list", "fan", "strip", "more"))
    primitives = [primitive]
    if how in ("fan", "strip"):
        d.words.append(f"triangle {how}s")
        primitives = []
        for a, b, c in faces:
            order = [a, b, c]
            primitives.append(
                primitive | {"indices": w.accessor(order, "H"), "mode": 6 if how == "fan" else 5}
            )
    else:
        primitive["indices"] = w.accessor(faces.ravel(), d.pick("BHI"))
        if how == "more":
            d.words.append("a primitive of lines")
            primitives.append({"attributes": attributes, "mode": 1})
            tell = tell or ("lines", "points", "triangles")
    nodes: list[dict[str, Any]] = [node]
    scenes, scene = [{"nodes": [0]}], 0
    if d.chance(0.1, "two scenes"):
        nodes.append({"mesh": 0, "translation": [3, 3, 3]})
        scenes, scene = [{"nodes": [1, 0]}, {"nodes": [0]}], 1
    if d.chance(0.08, "unknown required extension"):
        used.add("EXT_unheard_of")
        required.append("EXT_unheard_of")
    if "KHR_mesh_quantization" in used:
        required.append("KHR_mesh_quantization")
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": scene,
        "scenes": scenes,
        "nodes": nodes,
        "meshes": [{"primitives": primitives}],
        "accessors": w.accessors,
        "bufferViews": w.views,
    }
    optional: dict[str, Any] = {"images": images, "textures": textures}
    optional["materials"] = [material] if material else []
    optional |= {"samplers": samplers, "extensionsUsed": sorted(used), "extensionsRequired": required}
    document |= {name: value for name, value in optional.items() if value}
    refuse = "EXT_unheard_of" in required or (d.chance(0.2) and _break(document, d))
    path = _write(document, w.data, folder, d)

    low, high = vertices.min(0), vertices.max(0)
    expected: list[Any] = []
    for x, y in PLACES:
        number, weights, z = hit(vertices, faces, *(low[:2] + (x, y) * (high - low)[:2])) or (
            0,
            np.ones(3),
            0.0,
        )
        color = factor * (weights @ colors[faces[number]])
        if texture is not None:
            u, v = to_uv @ [*(weights @ coordinates[faces[number]]), 1.0]
            color = color * looked_up(texture, u, 1.0 - v, wrap, nearest)
        expected.append(
            ((z - high[2]) / (high - low)[0], color, {"roughness": rough, "metallic": metal} | opacity)
        )
    return Case(
        path,
        ", ".join(d.words),
        lambda tile: agree(tile, expected, 4e-3),
        bool(refuse),
        tell,
        bool(opacity),
        not tell,
    )


def _place(node: dict[str, Any], placed: F64, w: Writer, attributes: dict[str, int], d: Draws) -> None:
    """Positions that a node of the scene brings back to their place."""
    scale = np.round(d.rng.uniform(0.3, 3, 3), 2) * d.pick(((1, 1, 1), (1, 1, 1), (-1, 1, -1), (1, -1, 1)))
    move = np.round(d.rng.uniform(-2, 2, 3), 2)
    stored = (placed - move) / scale
    if d.chance(0.5, "matrix"):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.diag(scale), move
        node["matrix"] = matrix.T.ravel().tolist()
    else:
        d.words.append("translation, rotation, scale")
        # A quarter turn around x takes (x, y, z) to (x, -z, y).
        node |= {"translation": move.tolist(), "rotation": [2**-0.5, 0, 0, 2**-0.5]}
        node["scale"] = [scale[0], scale[2], scale[1]]
        stored = np.stack([stored[:, 0], stored[:, 2], -stored[:, 1]], axis=1)
        stored = stored * (1, 1, 1)
    attributes["POSITION"] = w.accessor(stored, "f")


def _break(document: dict[str, Any], d: Draws) -> bool:
    """Make the document invalid where every reader must refuse; whether it did."""
    kind = d.pick(("count", "view", "index", "factor", "nan", "cycle", "buffer", "type"), "broken:")
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    if kind == "count":
        accessor["count"] = d.pick((300_000_000, 1_000_000, -1, 10**18))
    elif kind == "view":
        document["bufferViews"][accessor["bufferView"]]["byteOffset"] = d.pick((10**9, -16, 10**15))
    elif kind == "index":
        document["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = d.pick((99, -1, "a", 10**30))
    elif kind in ("factor", "nan"):
        if not document.get("materials"):
            return False
        value = d.pick((1e9, -0.5, [1], "x")) if kind == "factor" else float("nan")
        document["materials"][0]["pbrMetallicRoughness"]["metallicFactor"] = value
    elif kind == "cycle":
        document["nodes"][0]["children"] = [0]
    elif kind == "buffer":
        document["buffers"] = [{"byteLength": 10**12}]
    else:
        accessor["type"] = d.pick(("VEC9", 5, "SCALAR"))
    return True


def _write(document: dict[str, Any], data: bytes, folder: Path, d: Draws) -> Path:
    """As GLB, or as .gltf beside its buffer or with the buffer inside."""
    form = d.pick(("glb", "glb", "gltf", "data"))
    buffers: list[dict[str, Any]] = [{"byteLength": len(data)}]
    if form == "glb":
        text = json.dumps({"buffers": buffers} | document).encode()
        text += b" " * (-len(text) % 4)
        data += b"\0" * (-len(data) % 4)
        chunks = (
            struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        )
        (folder / "tile.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return folder / "tile.glb"
    d.words.append("." + form)
    if form == "data":
        buffers[0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    else:
        (folder / "my buffer.bin").write_bytes(data)
        buffers[0]["uri"] = "my%20buffer.bin"
    (folder / "tile.gltf").write_text(json.dumps({"buffers": buffers} | document))
    return folder / "tile.gltf"


def damage(rng: Rng, folder: Path) -> Case:
    """A file of :func:`make` with damaged bytes: who reads it reads what trimesh reads, or refuses."""
    case, d = make(rng, folder), Draws(rng)
    case.path.write_bytes(damaged(case.path.read_bytes(), d))
    return Case(case.path, f"{case.text}; {', '.join(d.words)}")
