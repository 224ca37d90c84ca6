"""Sines and cosines of coordinates: what networks see of positions and directions.

A network of few layers learns fine structure from ``sin(2^k π p)`` and ``cos(2^k π p)`` that it does not
learn from p itself (NeRF, Mildenhall et al., ECCV 2020; for materials Xue et al., CGF 2024).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..config import EncodingSection


def encode(p: Tensor, bands: int, options: EncodingSection) -> Tensor:
    """Coordinates (..., d) → ``[p,] sin of all frequencies, cos of all frequencies``, (..., d·(2·bands [+
    1])).

    The frequencies of one coordinate stand side by side: ``2^0, 2^1, …, 2^(bands-1)``, times π where the
    options say so. No bands: the coordinates themselves.
    """
    if bands == 0:
        return p
    frequencies = 2.0 ** torch.arange(bands, dtype=p.dtype, device=p.device)
    angles = (p[..., None] * (frequencies * math.pi if options.pi else frequencies)).flatten(-2)
    parts = [p] if options.raw else []
    return torch.cat([*parts, angles.sin(), angles.cos()], -1)


def _size(coordinates: int, bands: int, options: EncodingSection) -> int:
    return coordinates * (2 * bands + options.raw) if bands else coordinates


def encode_direction(omega: Tensor, options: EncodingSection) -> Tensor:
    """What networks see of directions (..., 3): (..., :func:`direction_size`)."""
    return encode(omega if options.lifted else omega[..., :2], options.direction, options)


def direction_size(options: EncodingSection) -> int:
    """Numbers per direction."""
    return _size(3 if options.lifted else 2, options.direction, options)


def encode_position(u: Tensor, options: EncodingSection) -> Tensor:
    """What the decoder sees of uv positions (..., 2): (..., :func:`position_size`), nothing without bands.

    ``p = 2 (u mod 1) - 1``: with π every frequency repeats with the tile, so that there is no seam.
    """
    if options.position == 0:
        return u[..., :0]
    return encode(2.0 * (u - u.floor()) - 1.0, options.position, options)


def position_size(options: EncodingSection) -> int:
    """Numbers per position."""
    return _size(2, options.position, options) if options.position else 0


def encoding_formula(coordinates: str, bands: int, options: EncodingSection) -> str:
    """In words, for a reader of the export."""
    if bands == 0:
        return coordinates
    factor = "2^k pi" if options.pi else "2^k"
    raw = f"{coordinates}, then " if options.raw else ""
    return (
        f"{raw}sin({factor} p) for k = 0..{bands - 1} of the first coordinate p, then of the next, then cos "
        f"likewise; coordinates {coordinates}"
    )
