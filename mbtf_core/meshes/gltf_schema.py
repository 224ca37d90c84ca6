"""The parts of a glTF 2.0 document that are read, with the defaults and the ranges of its specification.

Properties have their names there. Others are ignored here; :mod:`~mbtf_core.meshes.gltf` warns of those that
change how a surface looks.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AliasPath, BaseModel, ConfigDict, Field

# Numbers are no texts and no booleans.
Number = Annotated[float, Field(strict=True)]
Share = Annotated[float, Field(strict=True, ge=0, le=1)]
NotNegative = Annotated[float, Field(strict=True, ge=0)]
Index = Annotated[int, Field(ge=0)]
Size = Annotated[int, Field(ge=1)]
Color = tuple[Share, Share, Share]
Vector = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]
# By columns.
Matrix = Annotated[list[Number], Field(min_length=16, max_length=16)]


class _Object(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


def _extension(name: str, default: Any) -> Any:
    """A property of an object that is one of its extensions."""
    return Field(default, validation_alias=AliasPath("extensions", name))


class GltfBuffer(_Object):
    """Bytes of a file, of a data URI, or of the GLB's own chunk."""

    byteLength: Size
    uri: str | None = None


class GltfBufferView(_Object):
    """A part of a buffer."""

    buffer: Index
    byteOffset: Index = 0
    byteLength: Size
    byteStride: Index = 0


class GltfSparsePart(_Object):
    """Numbers of replaced elements, which have a type of their own, or the elements."""

    bufferView: Index
    byteOffset: Index = 0
    componentType: int = 0


class GltfSparse(_Object):
    """Replaced elements of an accessor."""

    count: Size
    indices: GltfSparsePart
    values: GltfSparsePart


class GltfAccessor(_Object):
    """An array in a buffer view; zeros without one."""

    bufferView: Index | None = None
    byteOffset: Index = 0
    componentType: int
    normalized: bool = False
    count: Size
    type: str
    sparse: GltfSparse | None = None


class GltfImage(_Object):
    """A PNG or JPEG file, or one in a buffer view."""

    uri: str | None = None
    bufferView: Index | None = None


class GltfSampler(_Object):
    """How a texture is looked up."""

    magFilter: int | None = None
    wrapS: Literal[33071, 33648, 10497] = 10497
    wrapT: Literal[33071, 33648, 10497] = 10497


class GltfTexture(_Object):
    """An image and its sampler."""

    source: Index | None = None
    sampler: Index | None = None
    extensions: dict[str, Any] = {}


class GltfTextureTransform(_Object):
    """``KHR_texture_transform``."""

    offset: tuple[Number, Number] = (0.0, 0.0)
    rotation: Number = 0.0
    scale: tuple[Number, Number] = (1.0, 1.0)
    texCoord: Index | None = None


class GltfTextureInfo(_Object):
    """A reference to a texture, and the texture coordinates that place it."""

    index: Index
    texCoord: Index = 0
    transform: GltfTextureTransform = _extension("KHR_texture_transform", GltfTextureTransform())

    @property
    def uv_set(self) -> int:
        """Number of the texture coordinates."""
        own = self.transform.texCoord
        return self.texCoord if own is None else own


class GltfMetallicRoughness(_Object):
    """The base layer."""

    baseColorFactor: tuple[Share, Share, Share, Share] = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: GltfTextureInfo | None = None
    metallicFactor: Share = 1.0
    roughnessFactor: Share = 1.0
    metallicRoughnessTexture: GltfTextureInfo | None = None


class GltfClearcoat(_Object):
    """``KHR_materials_clearcoat``."""

    clearcoatFactor: Share = 0.0
    clearcoatTexture: GltfTextureInfo | None = None
    clearcoatRoughnessFactor: Share = 0.0
    clearcoatRoughnessTexture: GltfTextureInfo | None = None
    clearcoatNormalTexture: Any = None


class GltfSheen(_Object):
    """``KHR_materials_sheen``."""

    sheenColorFactor: Color = (0.0, 0.0, 0.0)
    sheenColorTexture: GltfTextureInfo | None = None
    sheenRoughnessFactor: Share = 0.0
    sheenRoughnessTexture: GltfTextureInfo | None = None


class GltfSpecular(_Object):
    """``KHR_materials_specular``."""

    specularFactor: Share = 1.0
    specularTexture: GltfTextureInfo | None = None
    specularColorFactor: tuple[NotNegative, NotNegative, NotNegative] = (1.0, 1.0, 1.0)
    specularColorTexture: GltfTextureInfo | None = None


class GltfIor(_Object):
    """``KHR_materials_ior``; 0 stands for a reflectance of 1."""

    ior: NotNegative = 1.5


class GltfMaterial(_Object):
    """What a surface reflects."""

    name: str = ""
    pbrMetallicRoughness: GltfMetallicRoughness | None = None
    normalTexture: Any = None
    occlusionTexture: Any = None
    emissiveFactor: tuple[NotNegative, NotNegative, NotNegative] = (0.0, 0.0, 0.0)
    alphaMode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alphaCutoff: NotNegative = 0.5
    clearcoat: GltfClearcoat = _extension("KHR_materials_clearcoat", GltfClearcoat())
    sheen: GltfSheen = _extension("KHR_materials_sheen", GltfSheen())
    specular: GltfSpecular = _extension("KHR_materials_specular", GltfSpecular())
    ior: GltfIor = _extension("KHR_materials_ior", GltfIor())
    specular_glossiness: Any = _extension("KHR_materials_pbrSpecularGlossiness", None)


class GltfPrimitive(_Object):
    """Triangles, lines or points of one material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    extensions: dict[str, Any] = {}


class GltfMesh(_Object):
    """What a node shows."""

    name: str = ""
    primitives: list[GltfPrimitive]
    weights: list[Number] = []


class GltfNode(_Object):
    """A place in the scene."""

    name: str = ""
    children: list[Index] = []
    matrix: Matrix | None = None
    translation: Vector | None = None
    rotation: Quaternion | None = None
    scale: Vector | None = None
    mesh: Index | None = None
    skin: Index | None = None
    weights: list[Number] = []
    instancing: Any = _extension("EXT_mesh_gpu_instancing", None)


class GltfScene(_Object):
    """Nodes that are shown together."""

    nodes: list[Index] = []


class GltfDocument(_Object):
    """A glTF document."""

    extensionsRequired: list[str] = []
    accessors: list[GltfAccessor] = []
    animations: list[Any] = []
    buffers: list[GltfBuffer] = []
    bufferViews: list[GltfBufferView] = []
    images: list[GltfImage] = []
    materials: list[GltfMaterial] = []
    meshes: list[GltfMesh] = []
    nodes: list[GltfNode] = []
    samplers: list[GltfSampler] = []
    scene: Index | None = None
    scenes: list[GltfScene] = []
    textures: list[GltfTexture] = []
