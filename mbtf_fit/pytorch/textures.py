"""Learned periodic textures, one level or a pyramid of them, and their blur.

Blurred textures learn coarse content first, and details as the blur shrinks. Without blur, neighboring texels
and the offset network converge to inconsistent parallaxes, and levels with few queries keep their random
initialization (NeuMIP, section 4.3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice
from mbtf_fit.pytorch.residuals import residuals_of, summed
from mbtf_fit.surface.lookup import Packing, lookup

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


class FeatureTextures(nn.Module):
    """Textures of some levels of a lattice, all of them independent parameters (NeuMIP, section 4.1), or what
    each adds to the next coarser one.

    Parameters
    ----------
    lattice : texel grids of the tile
    levels : the lattice's levels to hold, coarsest first; `level` of :meth:`forward` counts from the first
    channels : features per texel
    moves_lookups : whether the features are inputs of the offset network

    Attributes
    ----------
    texels : (texels, channels) parameter, all levels one after the other
    residual : whether levels are sums over the coarser ones; see :meth:`make_residual`
    settled : whether the parameter is what lookups read; see :meth:`settle`
    """

    def __init__(
        self, lattice: Lattice, levels: Sequence[int], channels: int, *, moves_lookups: bool = False
    ) -> None:
        super().__init__()
        self.moves_lookups = moves_lookups
        self.packing = Packing.of(lattice, levels)
        self.texels = nn.Parameter(torch.zeros(self.packing.texels, channels))
        self.residual = self.settled = False
        self._table: Tensor | None = None

    @property
    def table(self) -> Tensor:
        """What lookups read: the texels, or the last argument of :meth:`read`."""
        return self.texels if self._table is None else self._table

    def read(self, table: Tensor | None) -> None:
        """Let lookups read a table instead of the texels; None restores the texels."""
        # The texels themselves must not become a second parameter of the module.
        self._table = None if table is self.texels else table

    def make_residual(self) -> None:
        """From now on, let the parameter hold what each level adds to the next coarser one; lookups read the
        same (:mod:`mbtf_fit.pytorch.residuals`)."""
        self.read(self.texels.detach().clone())
        with torch.no_grad():
            self.texels.copy_(residuals_of(self.texels, self.packing))
        self.residual = True

    def settle(self, sigma: float) -> None:
        """After training, make what lookups read the parameter, blurred by `sigma`: neither blur nor sums
        follow."""
        with torch.no_grad():
            self.texels.copy_(self.blurred(sigma))
        self.read(None)
        self.residual, self.settled = False, True

    def blurred(self, sigma: float) -> Tensor:
        """What lookups read: the texels, blurred by a Gaussian of `sigma` texels of the finest level.

        Coarser levels get the same blur in tile widths: half as many texels each (as in the published
        code).
        """
        table: Tensor = self.texels
        if sigma > 0 and not self.settled:
            finest = self.packing.shapes[-1][1]
            levels = self.packing.split(table)
            table = self.packing.join(blur_texture(x, sigma * x.shape[1] / finest) for x in levels)
        return summed(table, self.packing) if self.residual else table

    def average_coarser(self, first: int) -> None:
        """Replace all levels coarser than `first` by averages of that level."""
        starts, shapes = self.packing.starts, self.packing.shapes
        if first <= 0:
            return
        with torch.no_grad():
            finer = self.texels[starts[first] : starts[first + 1]].t().view(1, -1, *shapes[first])
            averages = (nn.functional.adaptive_avg_pool2d(finer, shape)[0] for shape in shapes[:first])
            self.texels[: starts[first]] = torch.cat([a.flatten(1).t() for a in averages])

    def export(self) -> dict[str, Tensor]:
        """Current table by level, ``0`` the coarsest: (rows, columns, channels) each."""
        levels = self.packing.split(self.table.detach())
        return {str(s): level.clone() for s, level in enumerate(levels)}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Load tensors of :meth:`export`, to be read without blur; other entries are ignored."""
        self._table, self.residual, self.settled = None, False, False
        with torch.no_grad():
            self.texels.copy_(self.packing.join(tensors[str(s)] for s in range(len(self.packing.shapes))))

    def forward(self, u: Tensor, level: Tensor | None = None) -> Tensor:
        """Features (n, channels) at uv positions `u` (n, 2); see :func:`~mbtf_fit.surface.lookup.lookup`."""
        return lookup(self.table, self.packing, u, level)
