"""What a page holds of a material: textures, weights, shader code and test queries, as JSON."""

from __future__ import annotations

import base64
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_fit.material.format import DEFAULT_MIN_COS, QUERY
from mbtf_fit.material.material import Material, conformance_values
from mbtf_fit.ops.constants import AZIMUTHS, HEIGHTS, HORIZONS, MAPS
from mbtf_fit.viewer.shader import NODE_SHIFT, ShaderSource, node_blocks
from mbtf_fit.viewer.textures import F32, PackedTexture, pack

# Largest deviation from the material that a page may have, times max(1, value); that of half precision.
TOLERANCE = 1e-2
# Bits per number of the textures, the best first, and the bytes that textures may take in a page. With 6 bits
# the error is still below a tenth of that of a good fit.
_BITS, _SMALL = (8, 7, 6), 4.8e6


@dataclass(frozen=True)
class Rounding:
    """Difference of a page's rounded textures from the material, on its conformance queries.

    Attributes
    ----------
    bits : per number of the textures
    rms, largest : in 1/sr
    relative : rms over the root mean square value; 0 where all values are 0
    """

    bits: int
    rms: float
    largest: float
    relative: float

    def __str__(self) -> str:
        return (
            f"textures of {self.bits} bits: rms error {self.rms:.2g} 1/sr ({self.relative:.2g} of the rms "
            f"value), largest {self.largest:.2g} 1/sr"
        )


def encode(array: NDArray[Any]) -> str:
    """Bytes of an array in base64."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _families(material: Material, tensors: dict[str, F32]) -> dict[str, list[F32]]:
    """Levels of each texture, as they are stored: in place of second moments the standard deviation, which
    needs fewer bits."""
    out: dict[str, list[F32]] = {}
    for name, tensor in tensors.items():
        if tensor.ndim == 3 and name != HEIGHTS:
            out.setdefault(name.rpartition(".")[0], []).append(tensor.copy())
    for texels in out.get(MAPS, []):
        texels[..., 2] = _deviation(texels[..., 2], (texels[..., :2] ** 2).sum(-1))
    for texels in out.get(HORIZONS, []):
        texels[..., AZIMUTHS:] = _deviation(texels[..., AZIMUTHS:], texels[..., :AZIMUTHS] ** 2)
    if material.transmittance is not None:
        out["transmittance"] = list(material.transmittance.levels)
    return out


def _deviation(second_moment: F32, squared_mean: F32) -> F32:
    out: F32 = np.sqrt(np.maximum(second_moment - squared_mean, 0.0))
    return out


def _moments(name: str, texels: F32) -> F32:
    """Inverse of what :func:`_families` does to second moments."""
    texels = texels.copy()
    if name == MAPS:
        texels[..., 2] = texels[..., 2] ** 2 + (texels[..., :2] ** 2).sum(-1)
    if name == HORIZONS:
        texels[..., AZIMUTHS:] = texels[..., AZIMUTHS:] ** 2 + texels[..., :AZIMUTHS] ** 2
    return texels


def pack_textures(material: Material, bits: int = 8, effort: int = 9) -> dict[str, PackedTexture]:
    """All textures by name, with so many bits per number; heights have 12."""
    tensors = {name: t.cpu().float().numpy() for name, t in material.model.weights().items()}
    families = _families(material, tensors)
    packed = {n: pack(levels, bits, effort, alike=n == HORIZONS) for n, levels in families.items()}
    if HEIGHTS in tensors:
        packed[HEIGHTS] = pack([tensors[HEIGHTS]], 12, effort)
    return packed


def _fitting(material: Material) -> dict[str, PackedTexture]:
    """Textures of the most bits with which a page stays small, or of the fewest."""
    for bits in _BITS:
        packed = pack_textures(material, bits)
        if sum(len(texture.description["data"]) for texture in packed.values()) <= _SMALL:
            break
    return packed


def as_read(material: Material, packed: dict[str, PackedTexture]) -> Material:
    """The material with the textures that a page holds."""
    weights = material.model.weights()
    for name, texture in packed.items():
        if name == HEIGHTS:
            # Rounding may not lift the surface above the reference plane.
            weights[name] = torch.from_numpy(np.minimum(texture.levels[0], 0.0))
        elif name != "transmittance":
            for level, texels in enumerate(texture.levels):
                weights[f"{name}.{level}"] = torch.from_numpy(_moments(name, texels))
    model = material.model.empty_copy()
    model.load_weights(weights)
    transmittance = material.transmittance
    if transmittance is not None:
        transmittance = replace(transmittance, levels=list(packed["transmittance"].levels))
    rgb = conformance_values(model, material.conformance)
    return replace(
        material, model=model, conformance={**material.conformance, "rgb": rgb}, transmittance=transmittance
    )


def rounding(material: Material, read: Material, bits: int) -> Rounding:
    """Error of a page's textures."""
    exact = material.conformance["rgb"].astype(np.float64)
    difference = read.conformance["rgb"].astype(np.float64) - exact
    rms, power = float(np.sqrt((difference**2).mean())), float(np.sqrt((exact**2).mean()))
    return Rounding(bits, rms, float(np.abs(difference).max()), rms / power if power else 0.0)


def content_of(material: Material, name: str, packed: dict[str, PackedTexture]) -> dict[str, Any]:
    """What a page holds of a material with these textures, as JSON.

    Raises
    ------
    InputError
        The model is none that the viewer evaluates.
    """
    source = ShaderSource(material)
    text = source.text()
    tensors = material.model.weights()
    known, conformance = material.description, material.conformance
    training = known["training"]
    content: dict[str, Any] = {
        "name": name,
        "model": material.config.model,
        "aspect": material.lattice.aspect,
        "finest": material.lattice.finest,
        "min_cos": known["data"].get("min_cos", DEFAULT_MIN_COS),
        "source": text,
        "weights": encode(source.weights.array()),
        "textures": {name: texture.description for name, texture in packed.items()},
        "conformance": {q: encode(conformance[q]) for q in (*QUERY, "rgb")},
        "tolerance": TOLERANCE,
        "facts": {
            "levels": f"0 to {material.lattice.finest}",
            "network weights": sum(p.numel() for p in material.model.parameter_groups()[1]),
            "texels": sum(p.numel() for p in material.model.parameter_groups()[0]),
            "training steps": training.get("steps"),
            "training time in s": training.get("seconds"),
        },
    }
    if "calibration" in tensors:
        tables = tensors["calibration"].cpu().numpy()
        content["calibration"] = {"shape": list(tables.shape), "data": encode(tables.astype(np.float32))}
    if HEIGHTS in packed:
        rows, columns = packed[HEIGHTS].levels[0].shape[:2]
        content |= {"blocks": node_blocks(rows, columns), "node_shift": NODE_SHIFT}
    return content


def material_content(folder: Path, name: str | None = None) -> tuple[dict[str, Any], Rounding]:
    """What a page holds of a material.

    Parameters
    ----------
    folder : Path
        Folder made by ``mbtf-fit``.
    name : str, optional
        Shown in the page; the folder's name by default.

    Returns
    -------
    (dict, Rounding)
        JSON of the page, and the error of its textures.

    Raises
    ------
    InputError
        The material is missing or corrupt, or of a model that the viewer does not evaluate.
    """
    material = Material.load(folder)
    packed = _fitting(material)
    content = content_of(material, name or folder.resolve().name, packed)
    bits = packed["pyramid"].description["bits"]
    return content, rounding(material, as_read(material, packed), bits)
