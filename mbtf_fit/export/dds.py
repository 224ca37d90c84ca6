"""Quantized textures as DDS files, which engines stream and graphics hardware filters.

A file has a texture with all its mip levels as an array: a slice holds two channels where their number is
even (``BC5_UNORM`` or ``R8G8_UNORM``), else one. Heights are ``R16_UNORM``. The header is that of Direct3D 10
(learn.microsoft.com: Programming Guide for DDS). ``layers.json`` states what hardware's numbers in [0, 1]
stand for.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, UsageError
from mbtf_core.files.atomic import write_chunks
from mbtf_fit.export import Export, ExportTarget
from mbtf_fit.export.checks import check_stored
from mbtf_fit.export.json import LAYERS_NAME
from mbtf_fit.export.json import write as write_layers
from mbtf_fit.material.texture_formats import (
    BLOCK,
    QUANTIZED,
    UNBLOCKED,
    TextureFormat,
    decode,
    encode,
    grouped,
)
from mbtf_fit.ops.constants import FIBERS, HEIGHTS, HORIZONS, MAPS

_TEXTURES = ("pyramid", "offset_texture", "features", MAPS, FIBERS, HORIZONS, HEIGHTS)
_NAMES = [f"{name}.dds" for name in _TEXTURES]
# DXGI_FORMAT by bytes of a channel's texel or block, and channels of a slice.
_FORMATS = {(1, 1): 61, (1, 2): 49, (2, 1): 56, (8, 1): 80, (8, 2): 83}
# Before the data.
HEADER_BYTES = 148


def _together(channels: int) -> int:
    """Channels of a slice."""
    return 2 if channels % 2 == 0 else 1


def dds_chunks(codes: Sequence[NDArray[Any]], shape: Sequence[int]) -> list[bytes]:
    """A DDS file of a texture's integers by level, coarsest first, whose finest level has some rows and
    columns (:func:`~mbtf_fit.material.texture_formats.encode`)."""
    channels = codes[0].shape[2]
    pair = _together(channels)
    # (rows, columns, channels, bytes), finest first.
    levels = [c if c.ndim == 4 else c[..., None].view(np.uint8) for c in reversed(codes)]
    size = levels[0].shape[3]
    # Flags: which fields there are, and a texture with mip levels.
    header = struct.pack("<4s7I44x", b"DDS ", 124, 0x21007, *shape, 0, 0, len(levels))
    header += struct.pack("<2I4s5I5I", 32, 4, b"DX10", 0, 0, 0, 0, 0, 0x401008, 0, 0, 0, 0)
    header += struct.pack("<5I", _FORMATS[size, pair], 3, 0, channels // pair, 0)
    slices = [
        np.ascontiguousarray(level[:, :, first : first + pair]).tobytes()
        for first in range(0, channels, pair)
        for level in levels
    ]
    return [header, *slices]


def read_dds(data: bytes, like: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Inverse of :func:`dds_chunks`, for integers of the shapes and types of `like`."""
    channels = like[0].shape[2]
    pair = _together(channels)
    out, start = [np.empty_like(c) for c in like], HEADER_BYTES
    for first in range(0, channels, pair):
        for level in reversed(out):
            part = level[:, :, first : first + pair]
            found = np.frombuffer(data, level.dtype, part.size, start).reshape(part.shape)
            level[:, :, first : first + pair] = found
            start += found.nbytes
    return out


def _check(name: str, shapes: Sequence[tuple[int, ...]], form: TextureFormat) -> None:
    if name not in _TEXTURES:
        raise InputError(f"has no place for the texture '{name}'", where="--to dds")
    if form == "bc4" and name not in UNBLOCKED and (shapes[-1][0] % BLOCK or shapes[-1][1] % BLOCK):
        what = f"hardware needs multiples of 4 texels, and '{name}' has {shapes[-1][0]} x {shapes[-1][1]}"
        raise InputError(what, where="--to dds", hint="export with --texture-format unorm8")
    for (r, c, *_), (rows, columns, *_) in pairwise(shapes):
        if (r, c) != (max(rows // 2, 1), max(columns // 2, 1)):
            raise InputError(
                f"levels of '{name}' with {rows} x {columns} and {r} x {c} texels are no mip levels",
                where="--to dds",
                hint="export to exr or material: the aspect of the tile is no power of two",
            )


def write(export: Export, options: None) -> list[str]:
    """Write the textures, and ``layers.json`` with their ranges."""
    if export.form not in QUANTIZED:
        hint = "add --texture-format bc4, or unorm8"
        raise UsageError(f"has no textures in {export.form}", where="--to dds", hint=hint)
    weights = export.material.model.weights()
    textures = grouped(weights)
    for texture, names in textures.items():
        _check(texture, [tuple(weights[name].shape) for name in names], export.form)
    files = write_layers(export, None)
    layers = json.loads((export.folder / LAYERS_NAME).read_text(encoding="utf-8"))
    read: dict[str, Any] = {}
    for texture, names in textures.items():
        levels = [weights[name].cpu().numpy() for name in names]
        codes, limits = encode(texture, levels, export.form)
        path = export.folder / f"{texture}.dds"
        write_chunks(path, dds_chunks(codes, levels[-1].shape[:2]))
        files.append(path.name)
        found = read_dds(path.read_bytes(), codes)
        read |= {n: decode(c, limits, x.shape) for n, c, x in zip(names, found, levels, strict=True)}
    check_stored(layers, layers["tensors"] | read, export.material, export.folder / files[-1])
    return files


TARGET = ExportTarget(
    "dds",
    "quantized textures with mip levels for graphics hardware, and layers.json; with --texture-format",
    [*_NAMES, LAYERS_NAME],
    write,
)
