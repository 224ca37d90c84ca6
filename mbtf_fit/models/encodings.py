"""Sines and cosines of coordinates: what networks see of positions and directions.

A network of few layers learns fine structure from ``sin(2^k π p)`` and ``cos(2^k π p)`` that it does not
learn from p itself (NeRF, Mildenhall et al., ECCV 2020; for materials Xue et al., CGF 2024).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mbtf_fit.config import EncodingSection


def encode(p: Tensor, bands: int, pi: bool, options: EncodingSection, spread: Tensor | None = None) -> Tensor:
    """Coordinates (..., d) → ``[p,] sin of all frequencies, cos of all frequencies``, (..., d·(2·bands [+
    1])).

    The frequencies of one coordinate stand side by side: ``2^0, 2^1, …, 2^(bands-1)``, times π with `pi`;
    damped, band k is divided by 2^k, so that all are equally steep. No bands: the coordinates themselves.

    Parameters
    ----------
    spread : standard deviation (..., d) of a Gaussian around p; sines and cosines are then their means over
        it, ``exp(-(frequency·spread)²/2)`` times those at p
    """
    if bands == 0:
        return p
    frequencies = 2.0 ** torch.arange(bands, dtype=p.dtype, device=p.device)
    if pi:
        frequencies = frequencies * math.pi
    angles = (p[..., None] * frequencies).flatten(-2)
    sines, cosines = angles.sin(), angles.cos()
    if spread is not None or options.damped:
        size = torch.ones_like(frequencies)
        if options.damped:
            size = size * frequencies[0] / frequencies
        if spread is not None:
            size = size * (-0.5 * (spread[..., None] * frequencies).square()).exp()
        size = size.expand(*size.shape[:-2], p.shape[-1], bands).flatten(-2)
        sines, cosines = sines * size, cosines * size
    return torch.cat([*([p] if options.raw else []), sines, cosines], -1)


def _size(coordinates: int, bands: int, options: EncodingSection) -> int:
    return coordinates * (2 * bands + options.raw) if bands else coordinates


def encode_direction(omega: Tensor, options: EncodingSection) -> Tensor:
    """What networks see of directions (..., 3): (..., :func:`direction_size`)."""
    return encode(
        omega if options.lifted else omega[..., :2], options.direction, options.direction_pi, options
    )


def direction_size(options: EncodingSection) -> int:
    """Numbers per direction."""
    return _size(3 if options.lifted else 2, options.direction, options)


def encode_position(u: Tensor, level: Tensor, aspect: float, options: EncodingSection) -> Tensor:
    """What the decoder sees of uv positions (..., 2): (..., :func:`position_size`), nothing without bands.

    ``p = 2 (u mod 1) - 1``: with π every frequency repeats with the tile, so that there is no seam. Filtered,
    it is the mean over the footprint of fractional levels (...), ``2^-level`` in units of the first p: bands
    finer than it vanish (mip-NeRF, Barron et al., ICCV 2021). Otherwise they are noise to whatever reads
    them.
    """
    if options.position == 0:
        return u[..., :0]
    spread = None
    if options.filtered:
        spread = torch.exp2(-level)[..., None] / u.new_tensor([1.0, aspect])
    return encode(2.0 * (u - u.floor()) - 1.0, options.position, options.pi, options, spread)


def position_size(options: EncodingSection) -> int:
    """Numbers per position."""
    return _size(2, options.position, options) if options.position else 0


def encoding_formula(
    coordinates: str, bands: int, pi: bool, options: EncodingSection, spread: str = ""
) -> str:
    """In words, for a reader of the export; `spread` of every coordinate where they are filtered."""
    if bands == 0:
        return coordinates
    factor = "2^k pi" if pi else "2^k"
    raw = f"{coordinates}, then " if options.raw else ""
    left = ("2^-k " if options.damped else "") + (f"exp(-({factor} s)^2 / 2) " if spread else "")
    return (
        f"{raw}{left}sin({factor} p) for k = 0..{bands - 1} of the first coordinate p, then of the next, "
        f"then cos likewise; coordinates {coordinates}{spread}"
    )
