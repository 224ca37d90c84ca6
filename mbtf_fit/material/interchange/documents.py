"""Documents that name the maps: glTF 2.0, USD, MaterialX. Each describes one tile as a plane of width 1.

All of them name the neural material, which the maps approximate: its folder and the digest of its weights.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mbtf_fit.material.interchange.images import BASE_COLOR, HEIGHT, NORMAL, ORM, has_holes, height_range
from mbtf_fit.material.interchange.maps import Maps

GLTF, USD, MATERIALX = "material.gltf", "material.usda", "material.mtlx"


@dataclass(frozen=True)
class Source:
    """The neural material that maps are made of.

    Attributes
    ----------
    name : shown by other programs
    folder : its path from the documents
    model : of the material
    weights : SHA-256 of its weights
    """

    name: str
    folder: str
    model: str
    weights: str

    def described(self, maps: Maps) -> dict[str, Any]:
        """What the maps are of, as plain data."""
        return {
            "neural_material": self.folder,
            "model": self.model,
            "weights_sha256": self.weights,
            "level": maps.level,
            **({} if maps.heights is None else {"height_range_in_tile_widths": round(height_range(maps), 9)}),
        }


def refractive_index(f0: float) -> float:
    """Refractive index of a dielectric of this reflectance at normal incidence."""
    root = math.sqrt(min(max(f0, 0.0), 0.99))
    return (1.0 + root) / (1.0 - root)


def gltf(maps: Maps, source: Source) -> str:
    """A glTF 2.0 document: one tile in the plane z = 0, u along x, v along y."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [1, maps.aspect, 0], [0, maps.aspect, 0]], np.float32)
    normals = np.array(4 * [[0, 0, 1]], np.float32)
    tangents = np.array(4 * [[1, 0, 0, 1]], np.float32)
    # Texture coordinates of glTF have their origin at the upper left.
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    indices = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    arrays: list[NDArray[Any]] = [positions, normals, tangents, uv, indices]
    views, start = [], 0
    for array in arrays:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": array.nbytes})
        start += array.nbytes
    data = b"".join(array.tobytes() for array in arrays)
    kinds = ["VEC3", "VEC3", "VEC4", "VEC2", "SCALAR"]
    accessors: list[dict[str, Any]] = [
        {"bufferView": n, "componentType": 5126 if n < 4 else 5123, "count": len(array), "type": kind}
        for n, (array, kind) in enumerate(zip(arrays, kinds, strict=True))
    ]
    accessors[0] |= {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    glossy = maps.dielectric > 0
    extension = (
        {"KHR_materials_ior": {"ior": round(refractive_index(maps.dielectric), 6)}}
        if glossy
        else {"KHR_materials_specular": {"specularFactor": 0.0}}
    )
    document = {
        "asset": {"version": "2.0", "generator": "mbtf-fit"},
        "extensionsUsed": list(extension),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": source.name}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, "TANGENT": 2, "TEXCOORD_0": 3},
                        "indices": 4,
                        "material": 0,
                    }
                ]
            }
        ],
        "materials": [
            {
                "name": source.name,
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicRoughnessTexture": {"index": 2},
                },
                "normalTexture": {"index": 1},
                **({"alphaMode": "BLEND"} if has_holes(maps) else {}),
                "extensions": extension,
                "extras": {
                    **source.described(maps),
                    **({} if maps.heights is None else {"height_map": HEIGHT}),
                },
            }
        ],
        "textures": [{"sampler": 0, "source": n} for n in range(3)],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 10497, "wrapT": 10497}],
        "images": [{"uri": name} for name in (BASE_COLOR, NORMAL, ORM)],
        "buffers": [
            {
                "byteLength": len(data),
                "uri": f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}",
            }
        ],
        "bufferViews": views,
        "accessors": accessors,
    }
    return json.dumps(document, indent=1) + "\n"


def usd(maps: Maps, source: Source) -> str:
    """A USD layer with a plane and a UsdPreviewSurface; one scene unit is a tile's width."""
    inputs = {
        "diffuseColor": ("color3f", "base_color", "rgb", BASE_COLOR, "sRGB"),
        "normal": ("normal3f", "normal", "rgb", NORMAL, "raw"),
        "roughness": ("float", "roughness_metallic", "g", ORM, "raw"),
        "metallic": ("float", "roughness_metallic", "b", ORM, "raw"),
    }
    if has_holes(maps):
        inputs["opacity"] = ("float", "base_color", "a", BASE_COLOR, "sRGB")
    scale = {"normal": ("(2, 2, 2, 1)", "(-1, -1, -1, 0)")}
    moved = ""
    if maps.heights is not None:
        inputs["displacement"] = ("float", "height", "r", HEIGHT, "raw")
        scale["height"] = (
            f"({height_range(maps):.9g}, 0, 0, 1)",
            f"({maps.heights.min():.9g}, 0, 0, 0)",
        )
        moved = "token outputs:displacement"
    kinds = {"rgb": "float3", "r": "float", "g": "float", "b": "float", "a": "float"}
    lines = []
    for name, (kind, texture, channel, _, _) in inputs.items():
        lines.append(
            f"            {kind} inputs:{name}.connect = </Tile/Material/{texture}.outputs:{channel}>"
        )
    textures = {texture: (file, space) for _, texture, _, file, space in inputs.values()}
    blocks = []
    for texture, (file, space) in textures.items():
        used = sorted({channel for _, other, channel, _, _ in inputs.values() if other == texture})
        multiplied = scale.get(texture)
        blocks.append(
            "\n".join(
                [
                    f'        def Shader "{texture}"',
                    "        {",
                    '            uniform token info:id = "UsdUVTexture"',
                    f"            asset inputs:file = @{file}@",
                    f'            token inputs:sourceColorSpace = "{space}"',
                    '            token inputs:wrapS = "repeat"',
                    '            token inputs:wrapT = "repeat"',
                    *(
                        []
                        if multiplied is None
                        else [
                            f"            float4 inputs:scale = {multiplied[0]}",
                            f"            float4 inputs:bias = {multiplied[1]}",
                        ]
                    ),
                    "            float2 inputs:st.connect = </Tile/Material/st.outputs:result>",
                    *(f"            {kinds[c]} outputs:{c}" for c in used),
                    "        }",
                ]
            )
        )
    kinds_of = {str: "string", int: "int", float: "double"}
    data = "\n".join(
        f"        {kinds_of[type(value)]} {key} = {json.dumps(value, ensure_ascii=False)}"
        for key, value in source.described(maps).items()
    )
    ior = refractive_index(maps.dielectric)
    # Without gloss: the specular workflow, whose F0 is black.
    gloss = f"            float inputs:ior = {ior:.6g}"
    if maps.dielectric == 0:
        gloss = "            int inputs:useSpecularWorkflow = 1\n"
        gloss += "            color3f inputs:specularColor = (0, 0, 0)"
    height = f"{maps.aspect:.9g}"
    connected = f"        {moved}.connect = </Tile/Material/Surface.outputs:displacement>" if moved else ""
    body = "\n".join(lines)
    return f"""#usda 1.0
(
    defaultPrim = "Tile"
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "Tile" (
    customData = {{
{data}
    }}
)
{{
    def Mesh "Plane" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, {height}, 0), (0, {height}, 0)]
        normal3f[] normals = [(0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 1)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (
            interpolation = "vertex"
        )
        uniform token subdivisionScheme = "none"
        rel material:binding = </Tile/Material>
    }}

    def Material "Material"
    {{
        token outputs:surface.connect = </Tile/Material/Surface.outputs:surface>
{connected}

        def Shader "Surface"
        {{
            uniform token info:id = "UsdPreviewSurface"
{gloss}
{body}
            token outputs:surface
            {moved}
        }}

        def Shader "st"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}

{chr(10).join(blocks)}
    }}
}}
"""


def materialx(maps: Maps, source: Source) -> str:
    """A MaterialX document with the node ``gltf_pbr``."""
    root = ElementTree.Element("materialx", version="1.38")
    described = ", ".join(f"{k} {v}" for k, v in source.described(maps).items())
    root.set("doc", described)
    graph = ElementTree.SubElement(root, "nodegraph", name="maps")

    def image(name: str, kind: str, file: str, space: str | None = None) -> None:
        node = ElementTree.SubElement(graph, "image", name=name, type=kind)
        given = {"name": "file", "type": "filename", "value": file}
        ElementTree.SubElement(node, "input", given | ({} if space is None else {"colorspace": space}))

    def output(name: str, kind: str, node: str) -> None:
        ElementTree.SubElement(graph, "output", name=name, type=kind, nodename=node)

    def extract(name: str, kind: str, node: str, index: int) -> None:
        found = ElementTree.SubElement(graph, "extract", name=name, type="float")
        ElementTree.SubElement(found, "input", name="in", type=kind, nodename=node)
        ElementTree.SubElement(found, "input", name="index", type="integer", value=str(index))

    holes = has_holes(maps)
    if holes:
        image("base_rgba", "color4", BASE_COLOR, "srgb_texture")
        converted = ElementTree.SubElement(graph, "convert", name="base", type="color3")
        ElementTree.SubElement(converted, "input", name="in", type="color4", nodename="base_rgba")
        extract("alpha", "color4", "base_rgba", 3)
        output("alpha_out", "float", "alpha")
    else:
        image("base", "color3", BASE_COLOR, "srgb_texture")
    image("normal_image", "vector3", NORMAL)
    mapped = ElementTree.SubElement(graph, "normalmap", name="normal", type="vector3")
    ElementTree.SubElement(mapped, "input", name="in", type="vector3", nodename="normal_image")
    image("packed", "vector3", ORM)
    extract("roughness", "vector3", "packed", 1)
    extract("metallic", "vector3", "packed", 2)
    for name, kind in (
        ("base", "color3"),
        ("normal", "vector3"),
        ("roughness", "float"),
        ("metallic", "float"),
    ):
        output(f"{name}_out", kind, name)

    surface = ElementTree.SubElement(root, "gltf_pbr", name="surface", type="surfaceshader")

    def connected(name: str, kind: str, out: str) -> None:
        ElementTree.SubElement(surface, "input", name=name, type=kind, nodegraph="maps", output=out)

    connected("base_color", "color3", "base_out")
    connected("normal", "vector3", "normal_out")
    connected("roughness", "float", "roughness_out")
    connected("metallic", "float", "metallic_out")
    if holes:
        connected("alpha", "float", "alpha_out")
        ElementTree.SubElement(surface, "input", name="alpha_mode", type="integer", value="2")
    ior = f"{refractive_index(maps.dielectric):.6g}"
    ElementTree.SubElement(surface, "input", name="ior", type="float", value=ior)
    if maps.dielectric == 0:
        ElementTree.SubElement(surface, "input", name="specular", type="float", value="0")
    shown = ElementTree.SubElement(root, "surfacematerial", name="Material", type="material")
    ElementTree.SubElement(shown, "input", name="surfaceshader", type="surfaceshader", nodename="surface")
    if maps.heights is not None:
        image("height", "float", HEIGHT)
        # Value of the image at height 0; heights are at most that.
        plane = -float(maps.heights.min()) / (height_range(maps) or 1.0)
        below = ElementTree.SubElement(graph, "subtract", name="below_plane", type="float")
        ElementTree.SubElement(below, "input", name="in1", type="float", nodename="height")
        ElementTree.SubElement(below, "input", name="in2", type="float", value=f"{plane:.9g}")
        output("height_out", "float", "below_plane")
        moved = ElementTree.Element("displacement", name="relief", type="displacementshader")
        root.insert(list(root).index(shown), moved)
        ElementTree.SubElement(
            moved, "input", name="displacement", type="float", nodegraph="maps", output="height_out"
        )
        ElementTree.SubElement(moved, "input", name="scale", type="float", value=f"{height_range(maps):.9g}")
        ElementTree.SubElement(
            shown, "input", name="displacementshader", type="displacementshader", nodename="relief"
        )
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


WRITERS = {"gltf": (GLTF, gltf), "usd": (USD, usd), "materialx": (MATERIALX, materialx)}
