"""Formats of stored textures: floats, 8 bits, and blocks that graphics hardware reads.

In the formats ``unorm8`` and ``bc4``, a channel has one range [low, high] for all levels, so that hardware
can interpolate between them; numbers are ``low + (high - low) · code / largest code``. ``bc4`` stores each
channel of 4 × 4 texels in 8 bytes: two end points of 8 bits, and 3 bits per texel for its place between them
(Direct3D's ``BC4_UNORM``). Learned channels differ from each other. BC7, in which up to four channels share
lines, takes half the bytes of BC4 and makes three to five times the error.

Textures are rounded after training. Steps that read rounded textures, with gradients passed straight through,
leave the same error: a ratio of 1.000 ± 0.004 over seven pairs of fits.

Heights have 16 bits in both formats, as view rays are traced to them, and maps 8: highlights depend on their
slopes and roughness, which in blocks add a tenth to the error of glossy `turtle_shell`. Horizons have 8 bits
too, as their variance is a difference: in blocks, or without their finest level, they would save a third of
the bytes of ``bc4`` and add 4 to 40% to the error. Moments of slopes are clamped, 0.5% of the texels on
either side: a few steep ones would leave others too few steps, which added 7% to the error of a fit of
``twisted_wool`` and now adds 1.5%. What has been decoded is encoded to the same numbers again: end points
are the extremes of a block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_fit.ops.constants import HEIGHTS, HORIZONS, MAPS

TextureFormat = Literal["float32", "float16", "unorm8", "bc4"]
# Those with a range.
QUANTIZED: tuple[TextureFormat, ...] = ("unorm8", "bc4")
# Textures of whole numbers in both.
UNBLOCKED = (HEIGHTS, HORIZONS, MAPS)
# Texels along a side of a block, and steps between its end points.
BLOCK, STEPS = 4, 7
# Channels of the maps that hold moments of slopes, and the share of texels beyond either end of their range.
_MOMENTS, _BEYOND = slice(2, 5), 0.005
# Difference of places that single precision explains.
_EXACT = 0.01
# Ending of the names of ranges.
RANGE = ".range"

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]


def encode_blocks(numbers: F64) -> U8:
    """BC4 blocks (block rows, block columns, channels, 8) of numbers (rows, columns, channels) in [0, 255].
    Texels beyond a border repeat those at it, which are of the same block."""
    rows, columns, channels = numbers.shape
    padded = np.pad(numbers, ((0, -rows % BLOCK), (0, -columns % BLOCK), (0, 0)), mode="edge")
    down, across = padded.shape[0] // BLOCK, padded.shape[1] // BLOCK
    texels = padded.reshape(down, BLOCK, across, BLOCK, channels).transpose(0, 2, 4, 1, 3)
    texels = texels.reshape(down, across, channels, BLOCK * BLOCK)
    high, low = (np.floor(x + 0.5)[..., None] for x in (texels.max(-1), texels.min(-1)))
    place = (high - texels) * (STEPS / np.maximum(high - low, 1.0))
    # What rounds to an end point is not rounded away from it: decoded blocks have the same end points.
    top, bottom = texels >= high - 0.5, texels < low + 0.5
    place = np.where(top, np.floor(place + _EXACT), np.where(bottom, np.ceil(place - _EXACT), np.rint(place)))
    place = np.clip(place, 0, STEPS).astype(np.uint64)
    # Codes 0 and 1 are the end points, the high one first. A flat block has code 0 alone.
    place *= high > low
    codes = np.where(place == STEPS, 1, place + (place > 0)).astype(np.uint64)
    packed = (codes << (16 + 3 * np.arange(BLOCK * BLOCK, dtype=np.uint64))).sum(-1, dtype=np.uint64)
    packed |= (high.astype(np.uint64) | low.astype(np.uint64) << np.uint64(8))[..., 0]
    return packed[..., None].astype("<u8").view(np.uint8)


def decode_blocks(blocks: U8, rows: int, columns: int) -> NDArray[np.int64]:
    """Inverse of :func:`encode_blocks`: whole numbers (rows, columns, channels) from 0 to 255 · 7."""
    down, across, channels, _ = blocks.shape
    packed = np.ascontiguousarray(blocks).view("<u8")
    high, low = (packed & 255).astype(np.int64), (packed >> 8 & 255).astype(np.int64)
    code = (packed >> (16 + 3 * np.arange(BLOCK * BLOCK, dtype=np.uint64)) & 7).astype(np.int64)
    place = np.where(code == 1, STEPS, np.maximum(code - 1, 0))
    texels = (high * (STEPS - place) + low * place).reshape(down, across, channels, BLOCK, BLOCK)
    whole = texels.transpose(0, 3, 1, 4, 2).reshape(BLOCK * down, BLOCK * across, channels)
    return whole[:rows, :columns]


def range_of(name: str, levels: Sequence[F32]) -> F32:
    """Smallest and largest numbers (2, channels) of a texture's levels (rows, columns, channels), without
    the most extreme moments of slopes."""
    out = np.stack([np.min([x.min((0, 1)) for x in levels], 0), np.max([x.max((0, 1)) for x in levels], 0)])
    if name == MAPS:
        moments = np.concatenate([x[..., _MOMENTS].reshape(-1, 3) for x in levels])
        # Numbers of the texture, so that clamping again changes nothing.
        out[0, _MOMENTS] = np.quantile(moments, _BEYOND, 0, method="lower")
        out[1, _MOMENTS] = np.quantile(moments, 1.0 - _BEYOND, 0, method="higher")
    return out


def encode(name: str, levels: Sequence[F32], form: TextureFormat) -> tuple[list[NDArray[Any]], F32]:
    """A texture in a format of :data:`QUANTIZED`.

    Parameters
    ----------
    name : of the texture
    levels : (rows, columns, channels) arrays
    form : the format

    Returns
    -------
    (list of array, (2, channels) array)
        Integers of each level, and the channels' range: low, then high.
    """
    limits = range_of(name, levels)
    low, high = limits.astype(np.float64)
    span = high - low
    scale = np.divide(1.0, span, out=np.zeros_like(span), where=span > 0.0)
    shares = [np.clip((x - low) * scale, 0.0, 1.0) for x in levels]
    if name == HEIGHTS:
        codes: list[NDArray[Any]] = [np.rint(65535.0 * x).astype(np.uint16) for x in shares]
    elif form == "bc4" and name not in UNBLOCKED:
        codes = [encode_blocks(255.0 * x) for x in shares]
    else:
        codes = [np.rint(255.0 * x).astype(np.uint8) for x in shares]
    return codes, limits


def decode(code: NDArray[Any], limits: F32, shape: Sequence[int]) -> F32:
    """A level (rows, columns, channels) of a texture from integers and range of :func:`encode`.

    Raises
    ------
    ValueError : the integers have another shape
    """
    if code.ndim == 4:
        rows, columns, _ = shape
        if code.shape[:2] != (-(-rows // BLOCK), -(-columns // BLOCK)) or code.shape[3] != 8:
            raise ValueError(f"has blocks of the shape {code.shape}")
        share = decode_blocks(code, rows, columns) / (255 * STEPS)
    else:
        share = code / np.iinfo(code.dtype).max
    if share.shape != tuple(shape):
        raise ValueError(f"has the shape {share.shape} in place of {tuple(shape)}")
    low, high = limits.astype(np.float64)
    return (low + (high - low) * share).astype(np.float32)


def round_levels(name: str, levels: Sequence[F32], form: TextureFormat) -> list[F32]:
    """Levels (rows, columns, channels) of a texture as a reader of a quantized format gets them."""
    codes, limits = encode(name, levels, form)
    return [decode(code, limits, x.shape) for code, x in zip(codes, levels, strict=True)]


def grouped(tensors: Mapping[str, Any]) -> dict[str, list[str]]:
    """Texture → names of its levels, coarsest first, among tensors by name; other tensors are left out."""
    out: dict[str, list[str]] = {}
    for name in tensors:
        if tensors[name].ndim == 3:
            out.setdefault(texture_of(name), []).append(name)
    return {texture: sorted(names, key=lambda n: (len(n), n)) for texture, names in out.items()}


def texture_of(name: str) -> str:
    """Texture that a tensor is a level of, or the name of one without levels."""
    texture, _, level = name.rpartition(".")
    return texture if level.isdigit() else name


def range_name(name: str) -> str:
    """Tensor (2, channels) with the range of a texture's channels, from the name of one of its levels."""
    return texture_of(name) + RANGE
