"""Periodic maps, filtered with the Gaussian of each level."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mbtf_core.data.lattice import Lattice, sigma_of_level


def prefilter(image: Tensor, shape: tuple[int, int], sigma: float, aspect: float) -> Tensor:
    """Periodic map, filtered with a Gaussian and sampled on another grid, exactly: by its Fourier series.

    Parameters
    ----------
    image : (H, W, c) tensor, texels of a tile, row 0 at ``v → 1``
    shape : (int, int), rows and columns of the result. Frequencies beyond its own are left out.
    sigma : standard deviation in tile widths
    aspect : height of the tile over its width

    Returns
    -------
    (rows, columns, c) tensor
    """
    series = torch.fft.fft2(image.float(), dim=(0, 1))
    for axis, (size, length) in enumerate(zip(shape, (aspect, 1.0), strict=True)):
        given = image.shape[axis]
        wave = torch.fft.fftfreq(size, 1.0 / size, device=image.device).round()
        weight = torch.exp(-2.0 * (math.pi * sigma / length * wave).square()) * (size / given)
        # A wave at either grid's Nyquist frequency has no sign.
        weight = weight * (2.0 * wave.abs() < min(size, given))
        # Texel centers of both grids are half a texel from the border.
        shift = torch.polar(weight, math.pi * wave * (1.0 / size - 1.0 / given))
        series = series.index_select(axis, wave.long() % given)
        series = series * (shift[:, None, None] if axis == 0 else shift[None, :, None])
    return torch.fft.ifft2(series, dim=(0, 1)).real


def lookup_sigma(level: int, columns: int) -> float:
    """Standard deviation of the prefilter of a level whose texture has so many columns, in tile widths.

    A lookup at level s stands for the footprint σ_s. Bilinear interpolation between texels of width w adds
    the variance w²/6 of its tent, so that a map is filtered with the variance ``σ_s² - w²/6``.
    """
    width = 1.0 / columns
    return math.sqrt(max(float(sigma_of_level(level)) ** 2 - width**2 / 6.0, 0.0))


def prefiltered_levels(image: Tensor, lattice: Lattice) -> list[Tensor]:
    """Textures (rows, columns, c) of a map for all levels of a lattice, coarsest first.

    Parameters
    ----------
    image : (H, W, c) tensor, texels of the tile, row 0 at ``v → 1``
    lattice : levels and aspect of the tile
    """
    shapes = [lattice.shape(level) for level in range(lattice.finest + 1)]
    return [prefilter(image, s, lookup_sigma(k, s[1]), lattice.aspect) for k, s in enumerate(shapes)]
