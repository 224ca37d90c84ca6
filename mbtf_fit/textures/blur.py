"""Gaussian blur of periodic textures, and its annealing during training.

Blurred textures learn coarse content first, and details as the blur shrinks. Without blur, neighboring texels
and the offset network converge to inconsistent parallaxes, and levels with few queries keep their random
initialization (NeuMIP, section 4.3).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

# A Gaussian of fewer texels gives its neighbors less than 1e-5 of its weight.
NEGLIGIBLE = 0.21
# Standard deviations after which the Gaussian is cut off.
_REACH = 3.5
# Texels along an axis that are computed from one window.
_BLOCK = 32


def gaussian_taps(sigma: float, size: int) -> Tensor:
    """Weights (2·reach+1,) of a Gaussian of `sigma` texels, wrapped into a period of `size` texels; sum 1."""
    reach = math.ceil(_REACH * sigma)
    taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, dtype=torch.float64) / sigma) ** 2)
    if 2 * reach + 1 > size:
        index = torch.arange(-reach, reach + 1) % size
        taps = torch.zeros(size, dtype=torch.float64).index_add_(0, index, taps)
        # Centered again: texel 0 of the period in the middle of an odd number of taps.
        half = (size - 1) // 2
        even = taps[size // 2 : size // 2 + 1] / 2 if size % 2 == 0 else taps[:0]
        taps = torch.cat([even, taps[-half:] if half else taps[:0], taps[: half + 1], even])
    return taps / taps.sum()


def _blur_rows(flat: Tensor, taps: Tensor) -> Tensor:
    """Convolve the first axis of a periodic (size, n) array."""
    size, n = flat.shape
    reach = len(taps) // 2
    block = _BLOCK if size % _BLOCK == 0 else size
    window = block + 2 * reach
    toeplitz = torch.zeros(block, window, dtype=flat.dtype, device=flat.device)
    row = torch.arange(block, device=flat.device)[:, None]
    toeplitz[row, row + torch.arange(len(taps), device=flat.device)] = taps.to(flat)
    padded = torch.cat([flat[size - reach :], flat, flat[:reach]])
    windows = padded.unfold(0, window, block).transpose(1, 2)
    return torch.matmul(toeplitz, windows).reshape(size, n)


def _blur(texture: Tensor, sigma: float) -> Tensor:
    out = texture
    for axis in (0, 1):
        out = out.transpose(0, axis)
        if len(out) > 1:
            out = _blur_rows(out.reshape(len(out), -1), gaussian_taps(sigma, len(out))).view(out.shape)
        out = out.transpose(0, axis)
    return out


class _Blur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texture: Tensor, sigma: float) -> Tensor:
        ctx.sigma = sigma
        return _blur(texture, sigma)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        # A symmetric kernel is its own transpose.
        return _blur(gradients[0], ctx.sigma), None


def blur_texture(texture: Tensor, sigma: float) -> Tensor:
    """Blur a periodic texture (rows, columns, channels) with an isotropic Gaussian of `sigma` texels.

    One small matrix product per axis and block of texels; differentiable once.
    """
    if sigma < NEGLIGIBLE:
        return texture
    out: Tensor = _Blur.apply(texture, sigma)
    return out


def annealed_sigma(fraction: float, start: float, end: float) -> float:
    """Blur in texels of the finest level after a fraction of the annealing: ``start·(end/start)^fraction``.

    The paper's ``8·2^(-t/3333)`` in steps t is the same curve. Here it ends at a fraction of the budget, and
    is 0 from then on.
    """
    if start <= 0 or fraction >= 1:
        return 0.0
    return start * (end / start) ** max(fraction, 0.0)
