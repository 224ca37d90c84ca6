"""Materials of glTF 2.0 as the roles of a ``material.yaml``.

Factors are linear. Base colors and colors of sheen are stored as sRGB, all else linear; color profiles and
gammas of the images do not count, as the specification demands. A material without an image in a role has the
factor alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.images.read import LUMINANCE, Image, decode_image
from mbtf_core.meshes.content import F64, Texture, Value, Wrap, numbers_of
from mbtf_core.meshes.gltf_buffers import HINTS, GltfFile
from mbtf_core.meshes.gltf_schema import GltfMaterial, GltfMetallicRoughness, GltfSampler, GltfTextureInfo

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728
_RGB, _R, _G, _B, _A = (0, 1, 2), (0,), (1,), (2,), (3,)
# glTF has v down.
_FLIP = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
# Normal reflectance of `specular` 1, and below which its grazing reflectance falls
# (mbtf_gen.render.bsdf.microfacet.grazing_reflectance).
_SPECULAR_REFLECTANCE, _GRAZING_SLOPE = 0.08, 50.0
# Sheen of a smaller roughness is simulated with this one.
_SMALLEST_SHEEN = 0.07


@dataclass(frozen=True)
class _Source:
    """Where the value of a role comes from: a factor, and channels of a texture."""

    factor: float | F64
    texture: GltfTextureInfo | None = None
    channels: tuple[int, ...] = _RGB
    encoded: bool = False
    gray: bool = False

    @property
    def placed(self) -> GltfTextureInfo | None:
        """Its texture, unless the factor is zero."""
        return self.texture if np.any(self.factor) else None


class Materials:
    """The materials of a file, which takes up warnings, and the files of images that are read."""

    def __init__(self, file: GltfFile) -> None:
        self.file = file
        self._maps: dict[tuple[Any, ...], NDArray[np.float32]] = {}
        self._sets: dict[int | None, list[int]] = {}
        self._latest: tuple[int, Image] | None = None
        self._unused: dict[str, None] = {}

    def of(self, index: int | None) -> GltfMaterial:
        """A material; that of the specification without an index."""
        if index is None:
            return GltfMaterial()
        return self.file.entry(self.file.document.materials, index, "materials")

    def uv_sets(self, index: int | None) -> list[int]:
        """Numbers of the texture coordinates that its textures need, that of the base color first; 0 without
        textures."""
        if index not in self._sets:
            placed = (source.placed for source in self._sources(self.of(index)).values())
            found = dict.fromkeys(texture.uv_set for texture in placed if texture is not None)
            self._sets[index] = list(found) or [0]
        return self._sets[index]

    def read(
        self, material: GltfMaterial, uv_set: int | None
    ) -> tuple[dict[str, Value], dict[str, InputError]]:
        """What a material reflects: values by role, and faults by role that cannot be read, such as textures
        that need other texture coordinates than those of the shape, of the number `uv_set`."""
        values: dict[str, Value] = {}
        faults: dict[str, InputError] = {}
        for role, source in self._sources(material).items():
            try:
                values[role] = self._value(source, uv_set, material)
            except InputError as error:
                faults[role] = error
        if material.specular_glossiness is not None and material.pbrMetallicRoughness is None:
            what = f"material '{material.name}' has only specular and glossiness"
            fault = InputError(what, where=self.file.path, hint="export it with metallic and roughness")
            faults |= dict.fromkeys(("base_color", "roughness", "metallic"), fault)
        if "opacity" in values:
            cutoff = material.alphaCutoff if material.alphaMode == "MASK" else 1.0
            if np.min(numbers_of(values["opacity"])) >= cutoff:
                del values["opacity"]
            elif material.alphaMode == "MASK":
                values["opacity_cutoff"] = cutoff
        for text in _unused(material):
            if text not in self._unused:
                self._unused[text] = None
                self.file.warnings.append(text)
        return values, faults

    def _sources(self, material: GltfMaterial) -> dict[str, _Source]:
        """By role."""
        base = material.pbrMetallicRoughness or GltfMetallicRoughness()
        color, alpha = np.array(base.baseColorFactor[:3]), base.baseColorFactor[3]
        rough, coat, sheen = base.metallicRoughnessTexture, material.clearcoat, material.sheen
        found = {"base_color": _Source(color, base.baseColorTexture, encoded=True)}
        if material.alphaMode != "OPAQUE":
            found["opacity"] = _Source(alpha, base.baseColorTexture, _A)
        found |= {
            "roughness": _Source(base.roughnessFactor, rough, _G),
            "metallic": _Source(base.metallicFactor, rough, _B),
            "specular": _specular(material),
        }
        if coat.clearcoatFactor > 0:
            found |= {
                "clearcoat": _Source(coat.clearcoatFactor, coat.clearcoatTexture, _R),
                "clearcoat_roughness": _Source(
                    coat.clearcoatRoughnessFactor, coat.clearcoatRoughnessTexture, _G
                ),
            }
        if any(sheen.sheenColorFactor):
            found |= {
                "sheen": _Source(1.0),
                "sheen_color": _Source(
                    np.array(sheen.sheenColorFactor), sheen.sheenColorTexture, encoded=True
                ),
                "sheen_roughness": _Source(sheen.sheenRoughnessFactor, sheen.sheenRoughnessTexture, _A),
            }
        return found

    def _value(self, source: _Source, uv_set: int | None, material: GltfMaterial) -> Value:
        if (info := source.placed) is None:
            return source.factor
        if info.uv_set != uv_set:
            raise InputError(
                f"a texture of material '{material.name}' needs TEXCOORD_{info.uv_set}, which a part of it "
                "lacks, or has beside others",
                where=self.file.path,
                hint="bake its textures to the first texture coordinates, or unwrap it",
            )
        document = self.file.document
        texture = self.file.entry(document.textures, info.index, "textures")
        sampler = GltfSampler()
        if texture.sampler is not None:
            sampler = self.file.entry(document.samplers, texture.sampler, "samplers")
        if texture.source is None:
            hint = next((HINTS[name] for name in texture.extensions if name in HINTS), "")
            what = f"texture {info.index} has no image that is read"
            raise InputError(what, where=self.file.path, hint=hint or "export it with PNG or JPEG textures")
        placed = Texture(
            self._map(texture.source, source),
            (_WRAPS[sampler.wrapS], _WRAPS[sampler.wrapT]),
            sampler.magFilter == _NEAREST,
            (_FLIP @ _transform(info) @ _FLIP)[:2],
        )
        return placed, source.factor

    def _map(self, image: int, source: _Source) -> NDArray[np.float32]:
        """Linear colors (h, w, 3) or numbers (h, w) of some channels of an image."""
        key = (image, source.channels, source.encoded, source.gray)
        if key not in self._maps:
            decoded = self._image(image)
            # Gray images have the same number in all channels.
            count = decoded.stored.shape[2]
            colors = count - (count in (2, 4))
            if source.channels == _A and colors == count:
                out = np.ones((*decoded.shape, 1), np.float32)
            else:
                channels = [colors if c == 3 else min(c, colors - 1) for c in source.channels]
                out = decoded.linear(channels, source.encoded)
            out = out @ np.asarray(LUMINANCE) if source.gray else out if out.shape[2] > 1 else out[..., 0]
            self._maps[key] = np.ascontiguousarray(out, np.float32)
        return self._maps[key]

    def _image(self, index: int) -> Image:
        """An image of the file."""
        if self._latest is None or self._latest[0] != index:
            image = self.file.entry(self.file.document.images, index, "images")
            where = Path(f"{self.file.path}: image {index}")
            if image.uri is not None:
                content, path = self.file.of_uri(image.uri)
                where = path or where
            elif image.bufferView is not None:
                content = self.file.view(image.bufferView)[0].tobytes()
            else:
                raise InputError("has neither a file nor data", where=where)
            decoded = decode_image(content, ("PNG", "JPEG"), where)
            if decoded.tags.orientation != 1:
                self.file.warnings.append(f"image {index} is not turned as its EXIF data ask")
            self._latest = index, decoded
        return self._latest[1]


def _specular(material: GltfMaterial) -> _Source:
    """The dielectric lobe: its F0 is ``min(1, c·((n-1)/(n+1))²)·w`` with the color c, the weight w and the
    index of refraction n."""
    index, lobe = material.ior.ior, material.specular
    reflectance = ((index - 1.0) / (index + 1.0)) ** 2  # 1 for the index 0, as the extension demands
    color = float(np.dot(lobe.specularColorFactor, LUMINANCE))
    factor = min(1.0, reflectance * color) * lobe.specularFactor / _SPECULAR_REFLECTANCE
    if lobe.specularColorTexture is not None:
        return _Source(factor, lobe.specularColorTexture, encoded=True, gray=True)
    return _Source(factor, lobe.specularTexture, _A)


def _transform(info: GltfTextureInfo) -> F64:
    """Matrix (3, 3) of ``KHR_texture_transform``, v down. Its rotation turns the image clockwise."""
    given = info.transform
    c, s = np.cos(given.rotation), np.sin(given.rotation)
    scaled = np.array([[c, s], [-s, c]]) * given.scale
    return np.array([[*scaled[0], given.offset[0]], [*scaled[1], given.offset[1]], [0.0, 0.0, 1.0]])


def _unused(material: GltfMaterial) -> Iterator[str]:
    """What of a material is not used, or not exactly, in words."""
    base, sheen = material.pbrMetallicRoughness or GltfMetallicRoughness(), material.sheen
    if material.normalTexture is not None or material.clearcoat.clearcoatNormalTexture is not None:
        yield "normal textures are not used"
    if material.occlusionTexture is not None:
        yield "occlusion textures are not used: occlusion is simulated"
    if any(material.emissiveFactor):
        yield "emission is not used"
    if any(sheen.sheenColorFactor) and sheen.sheenRoughnessFactor < _SMALLEST_SHEEN:
        yield f"sheen of a roughness below {_SMALLEST_SHEEN} is simulated with {_SMALLEST_SHEEN}"
    lobe = material.specular
    if base.metallicFactor == 1.0 and base.metallicRoughnessTexture is None:
        return  # metal alone
    if lobe.specularColorTexture is not None or len(set(lobe.specularColorFactor)) > 1:
        yield "colors of specular lobes are used as gray"
    if lobe.specularColorTexture is not None and lobe.specularTexture is not None:
        yield "textures of the specular weight are not used beside those of its color"
    grazing = min(1.0, _GRAZING_SLOPE * _SPECULAR_REFLECTANCE * float(np.max(_specular(material).factor)))
    varying = lobe.specularColorTexture is not None or lobe.specularTexture is not None
    if varying or abs(grazing - lobe.specularFactor) > 1e-9:
        yield f"material '{material.name}': its specular lobe is approximated at grazing angles"
