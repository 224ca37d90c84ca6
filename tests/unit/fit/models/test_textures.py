"""Lookups in the feature pyramid, blur of its textures, and the annealing of the blur."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter1d

from mbtf_core.data.lattice import Lattice, texel_centers
from mbtf_fit.pytorch.residuals import enlarged
from mbtf_fit.pytorch.textures import FeatureTextures, annealed_sigma, blur_texture
from mbtf_fit.surface.lookup import Packing, coarse_level, lookup

F64 = torch.float64


def asymmetric(rows: int, columns: int) -> torch.Tensor:
    """A texture (rows·columns, 2) that differs in u and v, and from its mirror images."""
    i = torch.arange(columns, dtype=F64)[None, :].expand(rows, columns)
    j = torch.arange(rows, dtype=F64)[:, None].expand(rows, columns)
    return torch.stack([i + 0.3 * (i == 0), 10.0 * j + (j == 1)], -1).reshape(-1, 2)


@pytest.mark.parametrize("aspect", [1.0, 0.5, 0.6, 2.0])
def test_a_lookup_at_texel_centers_returns_the_texels(aspect: float) -> None:
    lattice = Lattice(3, aspect)
    rows, columns = lattice.shape()
    centers = torch.from_numpy(texel_centers(rows, columns).reshape(-1, 2))
    table = asymmetric(rows, columns)
    found = lookup(table, Packing.of(lattice, [3]), centers)
    torch.testing.assert_close(found, table, rtol=0, atol=1e-12)


def lookup_reference(
    table: torch.Tensor, packing: Packing, u: torch.Tensor, level: torch.Tensor | None
) -> torch.Tensor:
    """The same in plain PyTorch."""
    out, starts = table.new_zeros(len(u), table.shape[1]), packing.starts
    coarse, fine = coarse_level(torch.zeros_like(u[:, 0]) if level is None else level, len(packing.shapes))
    for s, (rows, columns) in enumerate(packing.shapes):
        weight = torch.where(coarse == s, 1 - fine, torch.where(coarse == s - 1, fine, 0))
        texture = table[starts[s] : starts[s + 1]].view(rows, columns, -1)
        x, y = u[:, 0] * columns - 0.5, (1 - u[:, 1]) * rows - 0.5
        i, j = x.floor().long(), y.floor().long()
        fx, fy = (x - i)[:, None], (y - j)[:, None]
        left, right, top, bottom = i % columns, (i + 1) % columns, j % rows, (j + 1) % rows
        upper = (1 - fx) * texture[top, left] + fx * texture[top, right]
        lower = (1 - fx) * texture[bottom, left] + fx * texture[bottom, right]
        out = out + weight[:, None] * ((1 - fy) * upper + fy * lower)
    return out


@pytest.mark.parametrize("aspect", [1.0, 0.4, 1.7])
@pytest.mark.parametrize("levels", [[3], [0, 1, 2, 3], [0]])
def test_fast_path_equals_the_reference(aspect: float, levels: list[int]) -> None:
    torch.manual_seed(0)
    packing = Packing.of(Lattice(3, aspect), levels)
    table = torch.randn(packing.texels, 5, dtype=F64, requires_grad=True)
    u = (6 * torch.rand(300, 2, dtype=F64) - 3).requires_grad_()
    level = 4 * torch.rand(300, dtype=F64) - 0.5 if len(levels) > 1 else None
    weight = torch.randn(300, 5, dtype=F64)
    results = []
    for function in (lookup, lookup_reference):
        out = function(table, packing, u, level)
        results.append((out, *torch.autograd.grad((out * weight).sum(), (table, u))))
    for fast, reference in zip(*results, strict=True):
        torch.testing.assert_close(fast, reference, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("rows", "columns", "sigma"),
    [(1, 8, 2.0), (3, 4, 1.7), (5, 6, 9.0), (2, 2, 0.5), (128, 64, 8.0), (64, 96, 0.4), (32, 1, 1.0)],
)
def test_blur_equals_scipys_wrapped_gaussian(rows: int, columns: int, sigma: float) -> None:
    texture = torch.randn(rows, columns, 3, dtype=torch.float64)
    expected = texture.numpy()
    for axis in (0, 1):
        expected = gaussian_filter1d(expected, sigma, axis=axis, mode="wrap", radius=math.ceil(3.5 * sigma))
    torch.testing.assert_close(blur_texture(texture, sigma), torch.from_numpy(expected))


def test_gradients_of_the_blur_are_finite_differences() -> None:
    texture = torch.randn(4, 32, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda t: blur_texture(t, 1.3), (texture,), fast_mode=True)


def test_a_negligible_blur_changes_nothing() -> None:
    texture = torch.randn(4, 4, 1)
    assert blur_texture(texture, 0.1) is texture


def test_annealing_ends_with_its_fraction_of_the_budget() -> None:
    sigmas = [annealed_sigma(share, 8.0, 0.25) for share in (0.0, 0.2, 0.5, 0.999, 1.0, 1.5)]
    assert sigmas[0] == 8.0
    assert sigmas[2] == pytest.approx((8.0 * 0.25) ** 0.5)
    assert sigmas == sorted(sigmas, reverse=True)
    assert sigmas[3] == pytest.approx(0.25, rel=0.01)
    assert sigmas[4:] == [0.0, 0.0]
    assert annealed_sigma(0.0, 0.0, 0.25) == 0.0


@pytest.mark.parametrize("aspect", [1.0, 0.7, 1.5])
def test_levels_as_sums_read_the_same_and_share_what_coarse_levels_learn(aspect: float) -> None:
    lattice = Lattice(4, aspect)
    texture = FeatureTextures(lattice, range(5), 3)
    torch.nn.init.normal_(texture.texels, generator=torch.Generator().manual_seed(1))
    before = texture.blurred(0.0).detach().clone()
    texture.make_residual()
    torch.testing.assert_close(texture.blurred(0.0), before, atol=1e-5, rtol=0)
    # The coarsest level is part of all others: a constant of it is added everywhere.
    with torch.no_grad():
        texture.texels[: texture.packing.starts[1]] += 2.0
    for sigma in (0.0, 1.5):
        moved = texture.blurred(sigma).detach()
        texture.texels.data[: texture.packing.starts[1]] -= 2.0
        torch.testing.assert_close(moved, texture.blurred(sigma).detach() + 2.0, atol=1e-5, rtol=0)
        texture.texels.data[: texture.packing.starts[1]] += 2.0


def test_interpolation_of_levels_is_exact_for_low_frequencies_and_keeps_the_mean() -> None:
    columns, rows = torch.arange(32), torch.arange(24)
    x, y = (columns + 0.5) / 32, (rows + 0.5) / 24
    coarse = torch.cos(2 * torch.pi * (x[None, :] + y[:, None]))[..., None]
    fine = enlarged(coarse, (48, 64))
    x, y = (torch.arange(64) + 0.5) / 64, (torch.arange(48) + 0.5) / 48
    expected = torch.cos(2 * torch.pi * (x[None, :] + y[:, None]))[..., None]
    # Half of the squared distance of two texels, by the second derivative; both axes.
    bound = 0.5 * (2 * math.pi) ** 2 * 0.25 * (1 / 32**2 + 1 / 24**2)
    assert float((fine - expected).abs().max()) < bound
    assert float(fine.mean()) == pytest.approx(float(coarse.mean()), abs=1e-6)
