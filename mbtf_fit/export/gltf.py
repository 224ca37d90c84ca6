"""A glTF 2.0 document that names maps: one tile as a plane of width 1."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.extras import import_extra
from mbtf_fit.export.images import BASE_COLOR, COAT, HEIGHT, NORMAL, ORM, document_target

if TYPE_CHECKING:
    from mbtf_fit.maps.maps import Maps

_NAME = "material.gltf"


def gltf(maps: Maps, name: str, described: dict[str, Any]) -> str:
    """A glTF 2.0 document: one tile in the plane z = 0, u along x, v along y."""
    gl = import_extra("pygltflib", _NAME)
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
        target = gl.ELEMENT_ARRAY_BUFFER if array.dtype == np.uint16 else gl.ARRAY_BUFFER
        views.append(gl.BufferView(buffer=0, byteOffset=len(data), byteLength=array.nbytes, target=target))
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
    images, extensions = [BASE_COLOR, NORMAL, ORM], dict[str, Any]()
    if maps.coat is not None:
        images.append(COAT)
        extensions["KHR_materials_clearcoat"] = {
            "clearcoatFactor": 1.0,
            "clearcoatTexture": {"index": 3},
            "clearcoatRoughnessFactor": 1.0,
            "clearcoatRoughnessTexture": {"index": 3},
            "clearcoatNormalTexture": {"index": 1},
        }
    if maps.dielectric > 0:
        extensions["KHR_materials_ior"] = {"ior": round(maps.refractive_index, 6)}
    else:
        extensions["KHR_materials_specular"] = {"specularFactor": 0.0}
    material = gl.Material(
        name=name,
        pbrMetallicRoughness=gl.PbrMetallicRoughness(
            baseColorTexture=gl.TextureInfo(index=0), metallicRoughnessTexture=gl.TextureInfo(index=2)
        ),
        normalTexture=gl.NormalMaterialTexture(index=1),
        alphaMode=gl.BLEND if maps.has_holes else gl.OPAQUE,
        alphaCutoff=None,
        extensions=extensions,
        extras=described | ({} if maps.heights is None else {"height_map": HEIGHT}),
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
        nodes=[gl.Node(mesh=0, name=name)],
        meshes=[gl.Mesh(primitives=[primitive])],
        materials=[material],
        textures=[gl.Texture(sampler=0, source=n) for n in range(len(images))],
        samplers=[sampler],
        images=[gl.Image(uri=name) for name in images],
        buffers=[gl.Buffer(byteLength=len(data))],
        bufferViews=views,
        accessors=accessors,
    )
    document.set_binary_blob(data)
    document.convert_buffers(gl.BufferFormat.DATAURI)
    return str(document.to_json(indent=1)) + "\n"


TARGET = document_target("gltf", "maps and a glTF 2.0 document", _NAME, gltf, "pygltflib")
