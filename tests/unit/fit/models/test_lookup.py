"""Lookups in the feature pyramid: orientation, wrap, blending, derivatives; fast path and reference agree."""

from __future__ import annotations

import pytest
import torch

from mbtf_core.data.lattice import Lattice, texel_centers
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
