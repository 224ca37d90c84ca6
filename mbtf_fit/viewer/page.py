"""The page: one HTML file that holds everything, and opens without a server or a network; its content."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import torch
from markupsafe import Markup
from numpy.typing import NDArray

from mbtf_core.paths import real_path
from mbtf_fit.backends.shader.images import NODE_SHIFT, Layout, TexelImage
from mbtf_fit.backends.shader.program import TRANSMITTANCE, program_of
from mbtf_fit.backends.shader.syntax import GLSL
from mbtf_fit.material.format import DEFAULT_MIN_COS, QUERY
from mbtf_fit.material.material import Material, conformance_values
from mbtf_fit.material.rounding import RoundingError
from mbtf_fit.ops.constants import MAX_ANISOTROPY
from mbtf_fit.viewer.textures import F32, PackedTexture, pack

PAGE_NAME = "viewer.html"
# Parts of the script, in the order of their use.
_SCRIPTS = (
    "vectors.js",
    "data.js",
    "gl.js",
    "material.js",
    "shapes.js",
    "camera.js",
    "environment.js",
    "renderer.js",
    "state.js",
    "plots.js",
    "viewer.js",
    "panel.js",
    "pointer.js",
    "main.js",
)


def _read(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text()


def safe_json(content: Any) -> str:
    """JSON that no text in it can end early: a page may hold it in a script element."""
    text = json.dumps(content, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_page(content: Mapping[str, Any], title: str) -> str:
    """HTML of the viewer.

    Parameters
    ----------
    content : ``materials``, and optionally ``poster``, ``pictures``, ``mesh`` and ``environment``
        (:mod:`mbtf_fit.viewer.page`, :mod:`mbtf_fit.viewer.extras`)
    title : shown by the browser
    """
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    names = sorted(file.name for file in files(__package__).joinpath("page").iterdir())
    shaders = {name: _read(name) for name in names if name.endswith((".vert", ".frag"))}
    scene = "scene.frag"
    shaders[scene] = shaders[scene].replace("$MAX_ANISOTROPY", f"{MAX_ANISOTROPY:.1f}")
    script = 'const CONTENT = JSON.parse(document.getElementById("content").textContent);\n'
    # Our own files: nothing in them is escaped.
    return environment.from_string(_read("viewer.html")).render(
        title=title,
        style=Markup(_read("viewer.css")),
        content=Markup(safe_json({**content, "shaders": shaders})),
        script=Markup(script + "\n".join(_read(name) for name in _SCRIPTS)),
    )


# Largest deviation from the material that a page may have, times max(1, value); that of half precision.
TOLERANCE = 1e-2
# Bits per number of the textures, the best first, and the bytes that textures may take in a page. With 6 bits
# the error is still below a tenth of that of a good fit.
_BITS, _SMALL = (8, 7, 6), 4.8e6


def encode(array: NDArray[Any]) -> str:
    """Bytes of an array in base64."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _rounded(image: TexelImage) -> list[F32]:
    """Levels of an image as they are rounded: in place of second moments the standard deviation or the
    covariance, which need fewer bits."""
    levels = [texels.copy() for texels in image.levels]
    for texels in levels:
        for square, product, is_variance in _moments(image.layout, texels):
            square[:] = np.sqrt(np.maximum(square - product, 0.0)) if is_variance else square - product
    return levels


def _restored(layout: Layout, texels: F32) -> F32:
    """Inverse of :func:`_rounded`. Rounding may not lift a surface above the reference plane."""
    texels = np.minimum(texels, 0.0) if layout == "nodes" else texels.copy()
    for square, product, is_variance in _moments(layout, texels):
        square[:] = (square**2 if is_variance else square) + product
    return texels


def _moments(layout: Layout, texels: F32) -> list[tuple[F32, F32, bool]]:
    """Second moments as views of the texels, the product of their means, and whether both means are one."""
    if layout == "maps":
        x, y, xx, xy, yy = np.moveaxis(texels[..., :5], -1, 0)
        return [(xx, x * x, True), (xy, x * y, False), (yy, y * y, True)]
    if layout == "horizons":
        count = texels.shape[2] // 2
        return [(texels[..., count:], texels[..., :count] ** 2, True)]
    return []


def pack_textures(material: Material, bits: int = 8) -> dict[str, PackedTexture]:
    """All textures by name, with so many bits per number; heights have 12, the transmittance at most 6: it is
    not exact."""

    def bits_of(image: TexelImage) -> int:
        if image.layout == "nodes":
            return 12
        return min(bits, 6) if image.source.startswith(TRANSMITTANCE) else bits

    return {
        image.source: pack(_rounded(image), bits_of(image), alike=image.layout == "horizons")
        for image in program_of(material, GLSL).images
        if image.layout != "rows"
    }


def _fitting(material: Material) -> tuple[dict[str, PackedTexture], int]:
    """Textures of the most bits with which a page stays small, or of the fewest; and these bits."""
    for bits in _BITS:
        packed = pack_textures(material, bits)
        if sum(len(texture.description["data"]) for texture in packed.values()) <= _SMALL:
            break
    return packed, bits


def as_read(material: Material, packed: dict[str, PackedTexture]) -> Material:
    """The material with the textures that a page holds."""
    weights = material.model.weights()
    for image in program_of(material, GLSL).images:
        if image.source in packed and not image.source.startswith(TRANSMITTANCE):
            for level, texels in enumerate(packed[image.source].levels):
                name = image.source if image.layout == "nodes" else f"{image.source}.{level}"
                weights[name] = torch.from_numpy(_restored(image.layout, texels))
    model = material.model.empty_copy()
    model.load_weights(weights)
    transmittance = material.transmittance
    if transmittance is not None:
        layers = [list(packed[f"{TRANSMITTANCE}.{k}"].levels) for k in range(len(transmittance.depths))]
        transmittance = replace(transmittance, layers=layers)
    rgb = conformance_values(model, material.conformance)
    return replace(
        material, model=model, conformance={**material.conformance, "rgb": rgb}, transmittance=transmittance
    )


def content_of(material: Material, name: str, packed: dict[str, PackedTexture]) -> dict[str, Any]:
    """What a page holds of a material with these textures, as JSON.

    Raises
    ------
    InputError : it has an operation that shaders do not have
    """
    program = program_of(material, GLSL)
    known, conformance = material.description, material.conformance
    training = known["training"]
    kinds = ((image, "TABLE" if image.is_table else "IMAGE") for image in program.images)
    uniforms = [GLSL.image.format(kind=kind, name=image) for image, kind in kinds]
    return {
        "name": name,
        "model": material.model.name,
        "aspect": material.lattice.aspect,
        "finest": material.lattice.finest,
        "min_cos": known["data"].get("min_cos", DEFAULT_MIN_COS),
        "source": "\n".join([GLSL.prologue, *uniforms, program.code]),
        "weights": encode(program.weights),
        "images": [_image(image) for image in program.images],
        "textures": {name: texture.description for name, texture in packed.items()},
        "conformance": {q: encode(conformance[q]) for q in (*QUERY, "rgb")},
        "tolerance": TOLERANCE,
        "facts": {
            "levels": f"0 to {material.lattice.finest}",
            "network weights": sum(p.numel() for p in material.model.parameter_groups()[1]),
            "texture values": sum(p.numel() for p in material.model.parameter_groups()[0]),
            # Of the state that is kept.
            "training steps": training.get("kept_step") or training.get("steps"),
            "training time in s": training.get("seconds"),
        },
    }


def _image(image: TexelImage) -> dict[str, Any]:
    """What a page knows of an image besides its texels."""
    out: dict[str, Any] = {"name": image.name, "texture": image.source, "layout": image.layout}
    if image.layout == "rows":
        _, height, width, _ = (texels := image.texels()).shape
        return {**out, "width": width, "height": height, "data": encode(texels)}
    return {**out, "half": image.half, "shift": NODE_SHIFT}


def material_content(folder: Path, name: str | None = None) -> tuple[dict[str, Any], str]:
    """What a page holds of a material, as JSON, and the error of its textures in words.

    Parameters
    ----------
    folder : made by ``mbtf-fit``
    name : shown in the page; the folder's name by default

    Raises
    ------
    InputError : the material is missing or corrupt, or has an operation that shaders do not have
    """
    material = Material.load(folder)
    packed, bits = _fitting(material)
    content = content_of(material, name or real_path(folder).name, packed)
    after = as_read(material, packed).conformance["rgb"]
    return content, str(RoundingError.between(f"textures of {bits} bits", material.conformance["rgb"], after))
