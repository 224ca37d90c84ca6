r"""Distributions of slopes below footprints: center and scatter by maximum likelihood.

The slopes ``s = (dz/dx, dz/dy)`` of GGX facets (Walter et al. 2007) have the bivariate t-distribution with
two degrees of freedom (Ribardière et al. 2017),

    p(s) = 1 / (π √det A · (1 + (s - c)ᵀ A⁻¹ (s - c))²),    A = 2 C.

Its center c and scatter C are fitted to the slopes below each footprint. Unlike their mean and covariance,
which LEAN mapping uses (Olano and Baker 2010), they follow the peak of a distribution that is no Gaussian:
the tops of bricks rather than their mean with the mortar. Expectation and maximization alternate (Lange,
Little and Taylor 1989; the scatter is divided by the sum of weights: Kent, Tyler and Vardi 1994): slopes at
the distance ``d² = (s - c)ᵀ C⁻¹ (s - c)`` have the weight ``4 / (2 + d²)``.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_fit.threads import one_thread_each

# Steps of the fit; standard deviations of a footprint that its window has on each side; samples per standard
# deviation, at least, where texels are finer.
_STEPS, _REACH, _DENSITY = 10, 2.5, 24.0
# Least variance of slopes along an axis, added to the scatter in distances; numbers at once, for the cache.
_LEAST, _AT_ONCE = 1e-4, 1 << 18


def slope_distributions(
    slopes: NDArray[np.float32],
    moments: NDArray[np.float32],
    aspect: float,
    shape: tuple[int, int],
    sigma: float,
) -> Tensor:
    """Centers and scatters of the slopes below Gaussian footprints.

    Parameters
    ----------
    slopes : (H, W, 2) array, mean slopes of the texels of a tile, row 0 at ``v → 1``
    moments : (H, W, 3) array, means of ``sx²``, ``sx·sy``, ``sy²`` over each texel
    aspect : height of the tile over its width
    shape : (int, int), rows and columns of the footprints
    sigma : standard deviation of the footprints in tile widths

    Returns
    -------
    (rows, columns, 5) tensor
        c (2), then the moments ``c cᵀ + C`` (xx, xy, yy), which may be interpolated like those of slopes.
    """
    sample, within = _samples(slopes, moments, aspect, sigma)
    height, width = sample.shape[:2]
    (j, by_row), (i, by_column) = (
        _window(count, size, max(sigma * size / length, 0.25))
        for count, size, length in zip(shape, (height, width), (aspect, 1.0), strict=True)
    )
    count = j.shape[1] * i.shape[1]
    out = torch.empty(*shape, 5)
    rows = max(1, _AT_ONCE // (count * shape[1]))

    def fit_rows(start: int) -> None:
        part = slice(start, start + rows)
        at = j[part, None, :, None], i[None, :, None, :]
        weight = (by_row[part, None, :, None] * by_column[None, :, None, :]).reshape(-1, count)
        found = _fit(sample[at].reshape(-1, count, 2), within[at].reshape(-1, count, 3), weight)
        out[part] = found.reshape(-1, shape[1], 5)

    with one_thread_each() as threads, ThreadPoolExecutor(threads) as pool:
        list(pool.map(fit_rows, range(0, shape[0], rows)))
    return out


def _samples(
    slopes: NDArray[np.float32], moments: NDArray[np.float32], aspect: float, sigma: float
) -> tuple[Tensor, Tensor]:
    """Slopes (h, w, 2) and their covariances within a texel (h, w, 3): of all texels, or of one in each of
    equal blocks, at a random place, so that periodic patterns are sampled evenly."""
    x, y = np.moveaxis(slopes, -1, 0)
    within = moments - np.stack([x * x, x * y, y * y], -1)
    blocks = [
        _block(size, sigma * size / length)
        for size, length in zip(slopes.shape[:2], (aspect, 1.0), strict=True)
    ]
    grid = [size // block for size, block in zip(slopes.shape[:2], blocks, strict=True)]
    random = np.random.default_rng(0)
    j, i = (
        np.expand_dims(np.arange(n) * block, 1 - axis) + random.integers(0, block, grid)
        for axis, (n, block) in enumerate(zip(grid, blocks, strict=True))
    )
    return torch.from_numpy(slopes[j, i]), torch.from_numpy(within[j, i].astype(np.float32))


def _block(size: int, sigma: float) -> int:
    """Texels along a block: a power of two that divides the size."""
    block = 1
    while sigma / (2 * block) >= _DENSITY and size % (2 * block) == 0:
        block *= 2
    return block


def _window(count: int, size: int, sigma: float) -> tuple[Tensor, Tensor]:
    """Samples (count, n) around each footprint along a periodic axis, and their Gaussian weights."""
    center = (torch.arange(count) + 0.5) * (size / count) - 0.5
    reach = math.ceil(_REACH * sigma)
    index = center.round().long()[:, None] + torch.arange(-reach, reach + 1)
    weight = torch.exp(-0.5 * ((index - center[:, None]) / sigma).square())
    return index % size, weight / weight.sum(1, keepdim=True)


def _fit(s: Tensor, within: Tensor, weight: Tensor) -> Tensor:
    """Center and moments (n, 5) of samples (n, m, 2) with covariances (n, m, 3) and weights (n, m)."""
    total = weight
    for step in range(_STEPS):
        share = total / total.sum(1, keepdim=True)
        center = torch.einsum("nm,nmk->nk", share, s)
        x, y = (s - center[:, None]).unbind(-1)
        xx, xy, yy = x * x + within[..., 0], x * y + within[..., 1], y * y + within[..., 2]
        a, b, c = ((share * z).sum(1, keepdim=True) for z in (xx, xy, yy))
        if step < _STEPS - 1:
            a, c = a + _LEAST, c + _LEAST
            distance2 = (c * xx - 2.0 * b * xy + a * yy) / (a * c - b * b)
            total = weight * 4.0 / (2.0 + distance2)
    u, v = center.split(1, 1)
    return torch.cat([u, v, a + u * u, b + u * v, c + v * v], 1)
