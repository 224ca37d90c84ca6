"""Positional encoding of positions and directions by sines and cosines.

A network of few layers learns finer structure from ``sin(2^k π p)`` and ``cos(2^k π p)`` than from p itself
(NeRF, Mildenhall et al., ECCV 2020; for materials Xue et al., CGF 2024).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mbtf_fit.config import EncodingSection


def encode(p: Tensor, bands: int, pi: bool, options: EncodingSection, spread: Tensor | None = None) -> Tensor:
    """Coordinates (..., d) → ``[p,] sin of all frequencies, cos of all frequencies``, (..., d·(2·bands [+
    1])).

    The frequencies of one coordinate are adjacent: ``2^0, 2^1, …, 2^(bands-1)``, times π with `pi`. With
    ``band_attenuation``, band k is divided by 2^k, so that all have the same slope. Without bands: the
    coordinates themselves.

    Parameters
    ----------
    spread : standard deviation (..., d) of a Gaussian around p, over which sines and cosines are averaged:
        ``exp(-(frequency·spread)²/2)`` times those at p
    """
    if bands == 0:
        return p
    frequencies = _frequencies(bands, pi, p)
    angles = (p[..., None] * frequencies).flatten(-2)
    sines, cosines = angles.sin(), angles.cos()
    if spread is not None or options.band_attenuation:
        size = _band_factors(frequencies, options, spread)
        size = size.expand(*size.shape[:-2], p.shape[-1], bands).flatten(-2)
        sines, cosines = sines * size, cosines * size
    return torch.cat([*([p] if options.raw else []), sines, cosines], -1)


def _frequencies(bands: int, pi: bool, like: Tensor) -> Tensor:
    """Frequencies (bands,), of the type of another tensor."""
    frequencies = 2.0 ** torch.arange(bands, dtype=like.dtype, device=like.device)
    return frequencies * math.pi if pi else frequencies


def _band_factors(frequencies: Tensor, options: EncodingSection, spread: Tensor | None) -> Tensor:
    """Factors of sines and cosines (..., bands) by attenuation and spread (...)."""
    size = torch.ones_like(frequencies)
    if options.band_attenuation:
        size = size * frequencies[0] / frequencies
    if spread is not None:
        size = size * (-0.5 * (spread[..., None] * frequencies).square()).exp()
    return size


def encode_direction(omega: Tensor, options: EncodingSection) -> Tensor:
    """Encoded directions (..., 3): (..., :func:`direction_size`)."""
    return encode(
        omega if options.direction_xyz else omega[..., :2], options.direction, options.direction_pi, options
    )


def rotate_to_z(axis: Tensor, omega: Tensor) -> Tensor:
    """Directions (n, 3), rotated by the shortest rotation that takes unit vectors (n, 3) with z > 0 to z."""
    tangential = (axis[:, :2] * omega[:, :2]).sum(1, keepdim=True)
    share = omega[:, 2:] + tangential / (1.0 + axis[:, 2:])
    return torch.cat([omega[:, :2] - axis[:, :2] * share, axis[:, 2:] * omega[:, 2:] + tangential], 1)


def encode_directions(omega_i: Tensor, omega_o: Tensor, options: EncodingSection) -> Tensor:
    """Encoded light and view (n, 3): (n, :func:`directions_size`).

    With ``half_vector``, the half vector h and the difference vector follow: the light in a frame whose z is
    h (Rusinkiewicz, EGSR 1998). The shortest rotation to h defines the frame, which is continuous also where
    h is the normal.
    """
    parts = [encode_direction(omega, options) for omega in (omega_i, omega_o)]
    if options.half_vector:
        half = torch.nn.functional.normalize(omega_i + omega_o, dim=1)
        parts += [half, rotate_to_z(half, omega_i)]
    return torch.cat(parts, 1)


def encode_position(u: Tensor, level: Tensor, aspect: float, options: EncodingSection) -> Tensor:
    """Encoded uv positions (..., 2): (..., :func:`position_size`), empty without bands.

    ``p = 2 (u mod 1) - 1``: with π every frequency is periodic over the tile, so there is no seam. With
    ``footprint_filtered``, it is averaged over the footprint at fractional levels (...), whose standard
    deviation is ``2^-level`` in units of the first p, so that bands finer than the footprint vanish
    (mip-NeRF, Barron et al., ICCV 2021). Otherwise they alias.
    """
    if options.position == 0:
        return u[..., :0]
    spread = _position_spread(level, aspect) if options.footprint_filtered else None
    return encode(2.0 * (u - u.floor()) - 1.0, options.position, options.pi, options, spread)


def _position_spread(level: Tensor, aspect: float) -> Tensor:
    """Standard deviation (..., 2) of p over the footprint at fractional levels (...)."""
    return torch.exp2(-level)[..., None] / level.new_tensor([1.0, aspect])


def position_factors(level: Tensor, aspect: float, options: EncodingSection) -> Tensor:
    """Factors of the sines, and of the cosines, of :func:`encode_position` at levels (n,): (n, 2·bands), all
    bands of the first coordinate, then those of the second."""
    frequencies = _frequencies(options.position, options.pi, level)
    spread = _position_spread(level, aspect) if options.footprint_filtered else None
    return _band_factors(frequencies, options, spread).expand(len(level), 2, -1).flatten(1)


def directions_formula(options: EncodingSection) -> str:
    """Formula of :func:`encode_directions` as text for an export."""
    coordinates = "(x, y, z)" if options.direction_xyz else "(x, y)"
    text = encoding_formula(
        f"{coordinates} of omega_i, of omega_o", options.direction, options.direction_pi, options
    )
    if options.half_vector:
        text += (
            "; then h = normalize(omega_i + omega_o), then rotate(h, omega_i), where rotate(a, w) = (w.x - "
            "a.x * s, w.y - a.y * s, a.z * w.z + t), t = a.x * w.x + a.y * w.y, s = w.z + t / (1 + a.z)"
        )
    return text


def encoding_formula(
    coordinates: str, bands: int, pi: bool, options: EncodingSection, spread: str = ""
) -> str:
    """Formula as text for an export; `spread` of every coordinate where they are filtered."""
    if bands == 0:
        return coordinates
    factor = "2^k pi" if pi else "2^k"
    raw = f"{coordinates}, then " if options.raw else ""
    left = ("2^-k " if options.band_attenuation else "") + (f"exp(-({factor} s)^2 / 2) " if spread else "")
    return (
        f"{raw}{left}sin({factor} p) for k = 0..{bands - 1} of the first coordinate p, then of the next, "
        f"then cos likewise; coordinates {coordinates}{spread}"
    )
