"""A MaterialX document that names maps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mbtf_core.extras import import_extra
from mbtf_fit.export.images import BASE_COLOR, COAT, HEIGHT, NORMAL, ORM, document_target

if TYPE_CHECKING:
    from mbtf_fit.maps.maps import Maps

_NAME = "material.mtlx"


def materialx(maps: Maps, name: str, described: dict[str, Any]) -> str:
    """A MaterialX document with the node ``gltf_pbr``."""
    mx = import_extra("MaterialX", _NAME)
    document = mx.createDocument()
    document.setDocString(", ".join(f"{k} {v}" for k, v in described.items()))
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

    holes = maps.has_holes
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
    if maps.coat is not None:
        node("image", "coat", "vector3", file=("filename", COAT))
        for index, name in enumerate(("clearcoat", "clearcoat_roughness")):
            node("extract", name, "float", node_in=("vector3", "coat"), index=("integer", index))
            connect(surface, name, "float", name)
        coat_normal = surface.addInput("clearcoat_normal", "vector3")
        coat_normal.setNodeGraphString("maps")
        coat_normal.setOutputString("normal_out")
    surface.addInput("ior", "float").setValueString(f"{maps.refractive_index:.6g}")
    if maps.dielectric == 0:
        surface.addInput("specular", "float").setValueString("0")
    displacement = None
    if maps.heights is not None:
        # Value of the image at height 0; heights are at most that.
        plane = -float(maps.heights.min()) / (maps.height_range or 1.0)
        node("image", "height", "float", file=("filename", HEIGHT))
        node("subtract", "below_plane", "float", node_in1=("float", "height"), in2=("float", f"{plane:.9g}"))
        displacement = document.addNode("displacement", "relief", "displacementshader")
        connect(displacement, "displacement", "float", "below_plane")
        displacement.addInput("scale", "float").setValueString(f"{maps.height_range:.9g}")
    material = document.addMaterialNode("Material", surface)
    if displacement is not None:
        material.addInput("displacementshader", "displacementshader").setNodeName("relief")
    return str(mx.writeToXmlString(document))


TARGET = document_target("materialx", "maps and a MaterialX document", _NAME, materialx, "MaterialX")
