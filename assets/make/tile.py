"""The maps of one material, and how they are written so that every machine writes the same."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .noise import Field

# Heights are multiples of this many tile widths: far more than the last bit of a sine, far less than shows.
QUANTUM = 2.0**-14


@dataclass(frozen=True)
class Material:
    """What a material is made of; row 0 of every map is the side v → 1.

    Attributes
    ----------
    height : (H, W) in tile widths, from any zero
    base_color : (H, W, 3) in sRGB, [0, 1]
    roughness : (H, W) in [0, 1]
    index : refractive index of the substance; None leaves it at the 1.5 of the customary constant
    constants : lines of ``material.yaml`` below those of the maps
    """

    height: Field
    base_color: Field | None = None
    roughness: Field | None = None
    index: float | None = None
    constants: tuple[str, ...] = ()


def specular(index: float) -> float:
    """The `specular` constant s of a refractive index: reflectance 0.08 s at normal incidence (Burley
    2012)."""
    return ((index - 1.0) / (index + 1.0)) ** 2 / 0.08


def write(material: Material, folder: Path) -> None:
    """Write the maps of a material, rounded, the highest point at 0; and its ``material.yaml`` where there
    is a constant to state."""
    import OpenEXR
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    height = np.round((material.height - material.height.max()) / QUANTUM) * QUANTUM + 0.0
    header = {"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": height.astype(np.float32)}).write(str(folder / "height.exr"))
    maps = {"base_color": material.base_color, "roughness": material.roughness}
    for name, image in maps.items():
        if image is None:
            continue
        codes = np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
        Image.fromarray(codes).save(folder / f"{name}.png", optimize=True)
    constants = list(material.constants)
    if material.index is not None:
        constants += [f"specular: {specular(material.index):.2f} # refractive index {material.index:g}"]
    if constants:
        lines = [f"{name}: {name}.png" for name, image in maps.items() if image is not None]
        text = "\n".join(["height: height.exr", *lines, *constants, ""])
        (folder / "material.yaml").write_text(text, encoding="utf-8")
