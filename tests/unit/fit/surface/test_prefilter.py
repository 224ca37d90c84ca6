"""The Gaussian prefilter against the transfer function of a Gaussian and direct sums."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_fit.surface.known import prefilter, prefiltered_levels
from mbtf_fit.surface.lookup import Packing, lookup


@pytest.mark.parametrize(("given", "shape"), [((12, 16), (12, 16)), ((15, 9), (8, 6)), ((6, 8), (20, 31))])
@pytest.mark.parametrize("wave", [(0, 1), (2, 0), (1, -2)])
def test_a_wave_keeps_its_phase_and_the_gaussian_share_of_its_amplitude(
    given: tuple[int, int], shape: tuple[int, int], wave: tuple[int, int]
) -> None:
    aspect, sigma = 0.75, 0.08

    def cosine(rows: int, columns: int) -> np.ndarray:
        j, i = (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns
        return np.cos(2 * np.pi * (wave[0] * j[:, None] + wave[1] * i) + 0.4)

    found = prefilter(torch.from_numpy(cosine(*given))[..., None], shape, sigma, aspect)[..., 0]
    share = np.exp(-2 * (np.pi * sigma) ** 2 * ((wave[0] / aspect) ** 2 + wave[1] ** 2))
    np.testing.assert_allclose(found, share * cosine(*shape), atol=2e-6)


@pytest.mark.parametrize("shape", [(1, 1), (3, 8), (6, 7), (40, 9)])
def test_means_are_kept(shape: tuple[int, int]) -> None:
    image = torch.from_numpy(np.random.default_rng(0).random((6, 8, 2)))
    for sigma in (0.0, 0.3):
        found = prefilter(image, shape, sigma, 0.75)
        torch.testing.assert_close(found.mean((0, 1)), image.float().mean((0, 1)), atol=1e-6, rtol=0)


def test_lookups_are_gaussian_averages_wherever_they_fall() -> None:
    """Direct sums over a random map, at the centers and the corners of texels of two levels. Textures of
    twice the texels of a level have little error of interpolation."""
    size, lattice = 64, Lattice(3)
    image = np.random.default_rng(0).random((size, size, 1)).astype(np.float32)
    levels = prefiltered_levels(torch.from_numpy(image), lattice, finer=1)
    table = torch.cat([level.flatten(0, 1) for level in levels])
    packing = Packing.of(Lattice(4), range(1, 5))
    center = (np.arange(size) + 0.5) / size
    for level in (2, 3):
        u = np.random.default_rng(1).random((300, 2))
        u[:100] = (np.floor(u[:100] * 2**level) + 0.5) / 2**level
        u[100:200] = np.floor(u[100:200] * 2**level) / 2**level
        found = lookup(table, packing, torch.from_numpy(u).float(), torch.full((300,), float(level)))
        weights = []
        for x, cells in ((u[:, 1], 1 - center), (u[:, 0], center)):
            d = (x[:, None] - cells + 0.5) % 1 - 0.5
            w = sum(np.exp(-0.5 * ((d + k) / sigma_of_level(level)) ** 2) for k in (-1, 0, 1))
            weights.append(w / w.sum(1, keepdims=True))
        wanted = np.einsum("nj,ni,ji->n", *weights, image[..., 0])
        error = found[:, 0].numpy() - wanted
        assert np.sqrt((error**2).mean()) < 0.15 * wanted.std()
        for part in (slice(0, 100), slice(100, 200)):
            assert found[part, 0].numpy().std() == pytest.approx(wanted[part].std(), rel=0.1)
