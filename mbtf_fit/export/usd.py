"""A USD layer that names maps: one tile as a plane of width 1."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mbtf_core.extras import import_extra
from mbtf_fit.export.images import BASE_COLOR, COAT, HEIGHT, NORMAL, ORM, document_target

if TYPE_CHECKING:
    from mbtf_fit.maps.maps import Maps

_NAME = "material.usda"


def usd(maps: Maps, name: str, described: dict[str, Any]) -> str:
    """A USD layer with a plane and a UsdPreviewSurface; one scene unit is a tile's width."""
    Sdf, Usd, UsdGeom, UsdShade = (
        import_extra(f"pxr.{name}", _NAME) for name in ("Sdf", "Usd", "UsdGeom", "UsdShade")
    )
    types = Sdf.ValueTypeNames
    stage = Usd.Stage.CreateInMemory(".usda")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    tile = UsdGeom.Xform.Define(stage, "/Tile").GetPrim()
    stage.SetDefaultPrim(tile)
    for key, value in described.items():
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
        surface.CreateInput("ior", types.Float).Set(maps.refractive_index)
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
    if maps.coat is not None:
        coat = texture("clearcoat", COAT)
        connect("clearcoat", types.Float, coat, "r")
        connect("clearcoatRoughness", types.Float, coat, "g")
    if maps.has_holes:
        connect("opacity", types.Float, color, "a")
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    if maps.heights is not None:
        height = texture("height", HEIGHT)
        height.CreateInput("scale", types.Float4).Set((maps.height_range, 0, 0, 1))
        height.CreateInput("bias", types.Float4).Set((float(maps.heights.min()), 0, 0, 0))
        connect("displacement", types.Float, height, "r")
        moved = surface.CreateOutput("displacement", types.Token)
        material.CreateDisplacementOutput().ConnectToSource(moved)
    return str(stage.GetRootLayer().ExportToString())


TARGET = document_target("usd", "maps and a USD layer", _NAME, usd, "pxr")
