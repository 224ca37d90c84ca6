"""Directions and frequencies in PyTorch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mbtf_fit.ops import Frequencies


def rotate_to_z(axis: Tensor, omega: Tensor) -> Tensor:
    """Directions (n, 3), rotated by the shortest rotation that takes unit vectors (n, 3) with z > 0 to z."""
    tangential = (axis[:, :2] * omega[:, :2]).sum(1, keepdim=True)
    share = omega[:, 2:] + tangential / (1.0 + axis[:, 2:])
    return torch.cat([omega[:, :2] - axis[:, :2] * share, axis[:, 2:] * omega[:, 2:] + tangential], 1)


def stereographic(omega: Tensor) -> Tensor:
    """Directions (n, 3) projected from the nadir: (x, y) / (1 + z)."""
    return omega[..., :2] / (1.0 + omega[..., 2:])


def frequencies(x: Tensor, options: Frequencies, spread: Tensor | None) -> Tensor:
    """Coordinates (..., d) → ``[x,] sin of all frequencies, cos of all frequencies``; the frequencies of one
    coordinate are adjacent.

    Parameters
    ----------
    spread : standard deviation (..., d) of a Gaussian around x, over which sines and cosines are averaged
    """
    bands = 2.0 ** torch.arange(options.bands, dtype=x.dtype, device=x.device)
    bands = bands * math.pi if options.pi else bands
    angles = (x[..., None] * bands).flatten(-2)
    sines, cosines = angles.sin(), angles.cos()
    if spread is not None or options.attenuated:
        size = torch.ones_like(bands)
        if options.attenuated:
            size = size * bands[0] / bands
        if spread is not None:
            size = size * (-0.5 * (spread[..., None] * bands).square()).exp()
        size = size.expand(*size.shape[:-2], x.shape[-1], options.bands).flatten(-2)
        sines, cosines = sines * size, cosines * size
    return torch.cat([*([x] if options.raw else []), sines, cosines], -1)
