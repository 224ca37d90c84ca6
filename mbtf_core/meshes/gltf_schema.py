"""The parts of a glTF 2.0 document that are read, with the defaults and the ranges of its specification.

Properties have their names there. Others are ignored here; :mod:`~mbtf_core.meshes.gltf` warns of those that
change how a surface looks.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

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


class Asset(_Object):
    """Version of the format."""

    version: str
    minVersion: str | None = None


class Buffer(_Object):
    """Bytes of a file, of a data URI, or of the GLB's own chunk."""

    byteLength: Size
    uri: str | None = None


class BufferView(_Object):
    """A part of a buffer."""

    buffer: Index
    byteOffset: Index = 0
    byteLength: Size
    byteStride: Index = 0


class SparseIndices(_Object):
    """Elements that a sparse accessor replaces."""

    bufferView: Index
    byteOffset: Index = 0
    componentType: int


class SparseValues(_Object):
    """Their values."""

    bufferView: Index
    byteOffset: Index = 0


class Sparse(_Object):
    """Replaced elements of an accessor."""

    count: Size
    indices: SparseIndices
    values: SparseValues


class Accessor(_Object):
    """An array in a buffer view; zeros without one."""

    bufferView: Index | None = None
    byteOffset: Index = 0
    componentType: int
    normalized: bool = False
    count: Size
    type: str
    sparse: Sparse | None = None


class Image(_Object):
    """A PNG or JPEG file, or one in a buffer view."""

    uri: str | None = None
    bufferView: Index | None = None
    name: str = ""


class Sampler(_Object):
    """How a texture is looked up."""

    magFilter: int | None = None
    wrapS: Literal[33071, 33648, 10497] = 10497
    wrapT: Literal[33071, 33648, 10497] = 10497


class Texture(_Object):
    """An image and its sampler."""

    source: Index | None = None
    sampler: Index | None = None
    extensions: dict[str, Any] = {}


class TextureTransform(_Object):
    """``KHR_texture_transform``."""

    offset: tuple[Number, Number] = (0.0, 0.0)
    rotation: Number = 0.0
    scale: tuple[Number, Number] = (1.0, 1.0)
    texCoord: Index | None = None


class TextureExtensions(_Object):
    """Extensions of a reference to a texture."""

    transform: TextureTransform = Field(TextureTransform(), alias="KHR_texture_transform")


class TextureInfo(_Object):
    """A reference to a texture, and the texture coordinates that place it."""

    index: Index
    texCoord: Index = 0
    extensions: TextureExtensions = TextureExtensions()

    @property
    def uv_set(self) -> int:
        """Number of the texture coordinates."""
        own = self.extensions.transform.texCoord
        return self.texCoord if own is None else own


class MetallicRoughness(_Object):
    """The base layer."""

    baseColorFactor: tuple[Share, Share, Share, Share] = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: TextureInfo | None = None
    metallicFactor: Share = 1.0
    roughnessFactor: Share = 1.0
    metallicRoughnessTexture: TextureInfo | None = None


class Clearcoat(_Object):
    """``KHR_materials_clearcoat``."""

    clearcoatFactor: Share = 0.0
    clearcoatTexture: TextureInfo | None = None
    clearcoatRoughnessFactor: Share = 0.0
    clearcoatRoughnessTexture: TextureInfo | None = None
    clearcoatNormalTexture: Any = None


class Sheen(_Object):
    """``KHR_materials_sheen``."""

    sheenColorFactor: Color = (0.0, 0.0, 0.0)
    sheenColorTexture: TextureInfo | None = None
    sheenRoughnessFactor: Share = 0.0
    sheenRoughnessTexture: TextureInfo | None = None


class Specular(_Object):
    """``KHR_materials_specular``."""

    specularFactor: Share = 1.0
    specularTexture: TextureInfo | None = None
    specularColorFactor: tuple[NotNegative, NotNegative, NotNegative] = (1.0, 1.0, 1.0)
    specularColorTexture: TextureInfo | None = None


class Ior(_Object):
    """``KHR_materials_ior``; 0 stands for a reflectance of 1."""

    ior: NotNegative = 1.5


class MaterialExtensions(_Object):
    """Extensions of a material that are read."""

    clearcoat: Clearcoat = Field(Clearcoat(), alias="KHR_materials_clearcoat")
    sheen: Sheen = Field(Sheen(), alias="KHR_materials_sheen")
    specular: Specular = Field(Specular(), alias="KHR_materials_specular")
    ior: Ior = Field(Ior(), alias="KHR_materials_ior")
    specular_glossiness: Any = Field(None, alias="KHR_materials_pbrSpecularGlossiness")


class Material(_Object):
    """What a surface reflects."""

    name: str = ""
    pbrMetallicRoughness: MetallicRoughness | None = None
    normalTexture: Any = None
    occlusionTexture: Any = None
    emissiveFactor: tuple[NotNegative, NotNegative, NotNegative] = (0.0, 0.0, 0.0)
    alphaMode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alphaCutoff: NotNegative = 0.5
    extensions: MaterialExtensions = MaterialExtensions()


class Primitive(_Object):
    """Triangles, lines or points of one material."""

    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    extensions: dict[str, Any] = {}


class Mesh(_Object):
    """What a node shows."""

    name: str = ""
    primitives: list[Primitive]
    weights: list[Number] = []


class Instancing(_Object):
    """``EXT_mesh_gpu_instancing``."""

    attributes: dict[str, Index]


class NodeExtensions(_Object):
    """Extensions of a node that are read."""

    instancing: Instancing | None = Field(None, alias="EXT_mesh_gpu_instancing")


class Node(_Object):
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
    extensions: NodeExtensions = NodeExtensions()


class Scene(_Object):
    """Nodes that are shown together."""

    nodes: list[Index] = []


class Document(_Object):
    """A glTF document."""

    asset: Asset
    extensionsRequired: list[str] = []
    accessors: list[Accessor] = []
    animations: list[Any] = []
    buffers: list[Buffer] = []
    bufferViews: list[BufferView] = []
    images: list[Image] = []
    materials: list[Material] = []
    meshes: list[Mesh] = []
    nodes: list[Node] = []
    samplers: list[Sampler] = []
    scene: Index | None = None
    scenes: list[Scene] = []
    textures: list[Texture] = []
