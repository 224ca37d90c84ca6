"""Textures as one EXR file: a part per level, a channel per feature."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_core.files.atomic import write_through
from mbtf_fit.export import Export, ExportTarget
from mbtf_fit.material.transmittance import named_levels

if TYPE_CHECKING:
    from mbtf_fit.material.material import Material

TEXTURES_NAME = "textures.exr"


def channel_names(part: str, count: int) -> list[str]:
    """``f0``, ``f1``, …, with as many digits as the last one has, so that their order is that of the
    features; ``c0``, … of the transmittance's coefficients."""
    letter = "c" if part.startswith("transmittance.") else "f"
    return [f"{letter}{k:0{len(str(count - 1))}d}" for k in range(count)]


def texture_parts(material: Material) -> dict[str, Any]:
    """Part → texture (rows, columns, channels), coarsest level first: ``pyramid.0``, …,
    ``offset_texture.0``, ``transmittance.0.0``, … (layer and level)."""
    parts = {name: t.cpu().numpy() for name, t in material.model.weights().items() if t.ndim == 3}
    layers = {} if material.transmittance is None else named_levels(material.transmittance)
    return parts | {f"transmittance.{name}": texels for name, texels in layers.items()}


def write(export: Export, options: None) -> list[str]:
    """Write all textures, losslessly compressed; row 0 is the top, the side ``v → 1``.

    All parts share one display window, that of the finest level, as the format asks.
    """
    import OpenEXR

    rows, columns = export.material.lattice.shape()
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "displayWindow": ((0, 0), (columns - 1, rows - 1)),
        "mbtf.model": export.material.model.name,
    }
    parts = []
    for name, texture in texture_parts(export.material).items():
        planes = np.moveaxis(texture.astype(np.float16 if export.form == "float16" else np.float32), 2, 0)
        names = channel_names(name, len(planes))
        channels = {c: np.ascontiguousarray(plane) for c, plane in zip(names, planes, strict=True)}
        parts.append(OpenEXR.Part(dict(header), channels, name=name))
    path = export.folder / TEXTURES_NAME
    write_through(path, lambda path: OpenEXR.File(parts).write(str(path)))
    _check(export, path)
    return [TEXTURES_NAME]


def _check(export: Export, path: Path) -> None:
    """Evaluate what has been written."""
    import OpenEXR

    from mbtf_fit.export.checks import check_stored
    from mbtf_fit.material.material import describe_model

    model = export.material.model
    tensors = {name: t.cpu().numpy() for name, t in model.weights().items() if t.ndim != 3}
    with OpenEXR.File(str(path), separate_channels=True) as file:
        for part in file.parts:
            planes = [np.asarray(channel.pixels, np.float32) for _, channel in sorted(part.channels.items())]
            tensors[part.name()] = np.stack(planes, -1)
    check_stored(describe_model(model), tensors, export.material, path)


TARGET = ExportTarget(
    "exr",
    "the latent textures, a part per level and a channel per feature, and those of the transmittance of a "
    "material with holes",
    [TEXTURES_NAME],
    write,
)
