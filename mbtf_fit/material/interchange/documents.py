"""Documents that name the maps: glTF 2.0, USD, MaterialX. Each describes one tile as a plane of width 1.

pygltflib, usd-core and MaterialX write them. All of them name the neural material, which the maps
approximate: its folder and the digest of its weights.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import EngineError
from mbtf_fit.material.interchange.images import BASE_COLOR, HEIGHT, NORMAL, ORM, has_holes, height_range
from mbtf_fit.material.interchange.maps import Maps

# Modules that write the formats, and their packages.
_LIBRARIES = {
    "gltf": ("pygltflib", "pygltflib"),
    "usd": ("pxr", "usd-core"),
    "materialx": ("MaterialX", "MaterialX"),
}


def check_library(name: str) -> None:
    """An EngineError unless the library that writes a format is installed."""
    module, package = _LIBRARIES[name]
    if importlib.util.find_spec(module) is None:
        raise EngineError(
            f"{package} is not installed", where=f"--to {name}", hint="pip install 'mbtf[maps]'"
        )


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
    import pygltflib as gl

    # Texture coordinates of glTF have their origin at the upper left.
    arrays: dict[str, NDArray[Any]] = {
        "POSITION": np.array([[0, 0, 0], [1, 0, 0], [1, maps.aspect, 0], [0, maps.aspect, 0]], np.float32),
        "NORMAL": np.array(4 * [[0, 0, 1]], np.float32),
        "TANGENT": np.array(4 * [[1, 0, 0, 1]], np.float32),
        "TEXCOORD_0": np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32),
        "indices": np.array([0, 1, 2, 0, 2, 3], np.uint16),
    }
    views, accessors, data = [], [], b""
    for n, (name, array) in enumerate(arrays.items()):
        views.append(gl.BufferView(buffer=0, byteOffset=len(data), byteLength=array.nbytes))
        data += array.tobytes()
        accessor = gl.Accessor(
            bufferView=n,
            componentType=gl.UNSIGNED_SHORT if name == "indices" else gl.FLOAT,
            count=len(array),
            type="SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
        )
        if name == "POSITION":
            accessor.min, accessor.max = array.min(0).tolist(), array.max(0).tolist()
        accessors.append(accessor)
    if maps.dielectric > 0:
        extensions = {"KHR_materials_ior": {"ior": round(refractive_index(maps.dielectric), 6)}}
    else:
        extensions = {"KHR_materials_specular": {"specularFactor": 0.0}}
    material = gl.Material(
        name=source.name,
        pbrMetallicRoughness=gl.PbrMetallicRoughness(
            baseColorTexture=gl.TextureInfo(index=0), metallicRoughnessTexture=gl.TextureInfo(index=2)
        ),
        normalTexture=gl.NormalMaterialTexture(index=1),
        alphaMode=gl.BLEND if has_holes(maps) else gl.OPAQUE,
        alphaCutoff=None,
        extensions=extensions,
        extras=source.described(maps) | ({} if maps.heights is None else {"height_map": HEIGHT}),
    )
    attributes = gl.Attributes(POSITION=0, NORMAL=1, TANGENT=2, TEXCOORD_0=3)
    primitive = gl.Primitive(attributes=attributes, indices=4, material=0)
    sampler = gl.Sampler(
        magFilter=gl.LINEAR, minFilter=gl.LINEAR_MIPMAP_LINEAR, wrapS=gl.REPEAT, wrapT=gl.REPEAT
    )
    document = gl.GLTF2(
        asset=gl.Asset(generator="mbtf-fit"),
        extensionsUsed=list(extensions),
        scene=0,
        scenes=[gl.Scene(nodes=[0])],
        nodes=[gl.Node(mesh=0, name=source.name)],
        meshes=[gl.Mesh(primitives=[primitive])],
        materials=[material],
        textures=[gl.Texture(sampler=0, source=n) for n in range(3)],
        samplers=[sampler],
        images=[gl.Image(uri=name) for name in (BASE_COLOR, NORMAL, ORM)],
        buffers=[gl.Buffer(byteLength=len(data))],
        bufferViews=views,
        accessors=accessors,
    )
    document.set_binary_blob(data)
    document.convert_buffers(gl.BufferFormat.DATAURI)
    return str(document.to_json(indent=1)) + "\n"


def usd(maps: Maps, source: Source) -> str:
    """A USD layer with a plane and a UsdPreviewSurface; one scene unit is a tile's width."""
    from pxr import Sdf, Usd, UsdGeom, UsdShade

    types = Sdf.ValueTypeNames
    stage = Usd.Stage.CreateInMemory(".usda")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    tile = UsdGeom.Xform.Define(stage, "/Tile").GetPrim()
    stage.SetDefaultPrim(tile)
    for key, value in source.described(maps).items():
        tile.SetCustomDataByKey(key, value)
    mesh = UsdGeom.Mesh.Define(stage, "/Tile/Plane")
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, maps.aspect, 0), (0, maps.aspect, 0)])
    mesh.CreateNormalsAttr(4 * [(0, 0, 1)])
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    coordinates = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", types.TexCoord2fArray, UsdGeom.Tokens.vertex)
    coordinates.Set([(0, 0), (1, 0), (1, 1), (0, 1)])
    material = UsdShade.Material.Define(stage, "/Tile/Material")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)

    def shader(name: str, kind: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"/Tile/Material/{name}")
        made.CreateIdAttr(kind)
        return made

    surface, reader = shader("Surface", "UsdPreviewSurface"), shader("st", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    coordinate = reader.CreateOutput("result", types.Float2)
    if maps.dielectric > 0:
        surface.CreateInput("ior", types.Float).Set(refractive_index(maps.dielectric))
    else:
        # Without gloss: the specular workflow, whose F0 is black.
        surface.CreateInput("useSpecularWorkflow", types.Int).Set(1)
        surface.CreateInput("specularColor", types.Color3f).Set((0, 0, 0))

    def texture(name: str, file: str, space: str = "raw") -> Any:
        made = shader(name, "UsdUVTexture")
        made.CreateInput("file", types.Asset).Set(Sdf.AssetPath(file))
        made.CreateInput("sourceColorSpace", types.Token).Set(space)
        made.CreateInput("wrapS", types.Token).Set("repeat")
        made.CreateInput("wrapT", types.Token).Set("repeat")
        made.CreateInput("st", types.Float2).ConnectToSource(coordinate)
        return made

    def connect(name: str, kind: Any, image: Any, channel: str) -> None:
        output = image.CreateOutput(channel, types.Float3 if channel == "rgb" else types.Float)
        surface.CreateInput(name, kind).ConnectToSource(output)

    color, packed = texture("base_color", BASE_COLOR, "sRGB"), texture("roughness_metallic", ORM)
    normal = texture("normal", NORMAL)
    normal.CreateInput("scale", types.Float4).Set((2, 2, 2, 1))
    normal.CreateInput("bias", types.Float4).Set((-1, -1, -1, 0))
    connect("diffuseColor", types.Color3f, color, "rgb")
    connect("normal", types.Normal3f, normal, "rgb")
    connect("roughness", types.Float, packed, "g")
    connect("metallic", types.Float, packed, "b")
    if has_holes(maps):
        connect("opacity", types.Float, color, "a")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    if maps.heights is not None:
        height = texture("height", HEIGHT)
        height.CreateInput("scale", types.Float4).Set((height_range(maps), 0, 0, 1))
        height.CreateInput("bias", types.Float4).Set((float(maps.heights.min()), 0, 0, 0))
        connect("displacement", types.Float, height, "r")
        moved = surface.CreateOutput("displacement", types.Token)
        material.CreateDisplacementOutput().ConnectToSource(moved)
    return str(stage.GetRootLayer().ExportToString())


def materialx(maps: Maps, source: Source) -> str:
    """A MaterialX document with the node ``gltf_pbr``."""
    import MaterialX as mx

    document = mx.createDocument()
    document.setDocString(", ".join(f"{k} {v}" for k, v in source.described(maps).items()))
    graph = document.addNodeGraph("maps")
    surface = document.addNode("gltf_pbr", "surface", "surfaceshader")

    def node(category: str, name: str, kind: str, **inputs: tuple[str, Any]) -> None:
        """A node of the graph; inputs are (type, value), or (type, node) by ``node_`` before their name."""
        made = graph.addNode(category, name, kind)
        for key, (input_kind, value) in inputs.items():
            if key.startswith("node_"):
                made.addInput(key.removeprefix("node_"), input_kind).setNodeName(value)
            else:
                made.addInput(key, input_kind).setValueString(str(value))

    def connect(target: Any, name: str, kind: str, source_node: str) -> None:
        output = f"{source_node}_out"
        graph.addOutput(output, kind).setNodeName(source_node)
        connected = target.addInput(name, kind)
        connected.setNodeGraphString("maps")
        connected.setOutputString(output)

    holes = has_holes(maps)
    name, kind = ("base_rgba", "color4") if holes else ("base", "color3")
    node("image", name, kind, file=("filename", BASE_COLOR))
    graph.getNode(name).getInput("file").setColorSpace("srgb_texture")
    if holes:
        node("convert", "base", "color3", node_in=("color4", name))
        node("extract", "alpha", "float", node_in=("color4", name), index=("integer", 3))
        connect(surface, "alpha", "float", "alpha")
        surface.addInput("alpha_mode", "integer").setValueString("2")
    node("image", "normal_image", "vector3", file=("filename", NORMAL))
    node("normalmap", "normal", "vector3", node_in=("vector3", "normal_image"))
    node("image", "packed", "vector3", file=("filename", ORM))
    for index, channel in enumerate(("roughness", "metallic"), start=1):
        node("extract", channel, "float", node_in=("vector3", "packed"), index=("integer", index))
        connect(surface, channel, "float", channel)
    connect(surface, "base_color", "color3", "base")
    connect(surface, "normal", "vector3", "normal")
    surface.addInput("ior", "float").setValueString(f"{refractive_index(maps.dielectric):.6g}")
    if maps.dielectric == 0:
        surface.addInput("specular", "float").setValueString("0")
    displacement = None
    if maps.heights is not None:
        # Value of the image at height 0; heights are at most that.
        plane = -float(maps.heights.min()) / (height_range(maps) or 1.0)
        node("image", "height", "float", file=("filename", HEIGHT))
        node("subtract", "below_plane", "float", node_in1=("float", "height"), in2=("float", f"{plane:.9g}"))
        displacement = document.addNode("displacement", "relief", "displacementshader")
        connect(displacement, "displacement", "float", "below_plane")
        displacement.addInput("scale", "float").setValueString(f"{height_range(maps):.9g}")
    material = document.addMaterialNode("Material", surface)
    if displacement is not None:
        material.addInput("displacementshader", "displacementshader").setNodeName("relief")
    return str(mx.writeToXmlString(document))


WRITERS = {
    "gltf": ("material.gltf", gltf),
    "usd": ("material.usda", usd),
    "materialx": ("material.mtlx", materialx),
}
