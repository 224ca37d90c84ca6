"""Directions about fibers: one fiber, means over many, gaps, and the kernel against PyTorch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from support.fit_data import random_queries
from support.known_surfaces import rough_surface
from torch import Tensor
from torch.nn.functional import normalize

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.relief import known_surface
from mbtf_fit.native import library
from mbtf_fit.ops import FiberFrame
from mbtf_fit.surface import hints
from mbtf_fit.surface.fibers import fiber_frame
from mbtf_fit.surface.hints import compute_hints

N, VARIANCE = 500, 0.04
FRAME = FiberFrame("fibers", "hits", "level", "omega_i", "omega_o", "surface.fibers", 0.5)


def units(*shape: int, seed: int) -> Tensor:
    """Random unit vectors (..., 3)."""
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(
        torch.randn((*shape, 3), generator=generator, dtype=torch.float64), dim=-1
    )


def maps_of(tangents: Tensor, covered: float = 1.0) -> Tensor:
    """Maps (n, 7) of tangents (n, m, 3) that cover a share of the footprint."""
    moments = torch.einsum("nmi,nmj->nij", tangents, tangents) / tangents.shape[1]
    rows, columns = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
    return covered * torch.cat([moments[:, rows, columns], torch.full((len(moments), 1), VARIANCE)], 1)


def gaussian(x: Tensor, variance: float | Tensor) -> Tensor:
    return torch.exp(-0.5 * x * x / variance) / (2.0 * math.pi * variance) ** 0.5


@pytest.mark.parametrize("covered", [1.0, 0.3])
def test_one_direction_gives_the_angles_of_a_fiber(covered: float) -> None:
    tangent, light, view = (units(N, seed=seed) for seed in range(3))
    found = fiber_frame(FRAME, maps_of(tangent[:, None], covered), light, view)
    s_i, s_o = ((w * tangent).sum(1) for w in (light, view))
    # Azimuth between both, seen along the fiber.
    around = [
        torch.nn.functional.normalize(w - s[:, None] * tangent, dim=1) for w, s in ((light, s_i), (view, s_o))
    ]
    wanted = [
        covered * gaussian(s_i + s_o, VARIANCE),
        (around[0] * around[1]).sum(1),
        s_i**2,
        s_o**2,
        s_i * s_o,
        torch.full((N,), covered),
    ]
    far = (1.0 - s_i**2) * (1.0 - s_o**2) > FRAME.least_cosine**2
    torch.testing.assert_close(found[far], torch.stack(wanted, 1)[far], atol=1e-6, rtol=1e-6)


def test_the_lobe_is_the_mean_over_directions_about_an_axis() -> None:
    axis, light, view = (units(64, seed=seed) for seed in range(3, 6))
    # To first order, tangents differ from the axis by independent angles of 0.15 across it.
    spread, generator = 0.15, torch.Generator().manual_seed(9)
    around = torch.randn((64, 4000, 3), generator=generator, dtype=torch.float64) * spread
    tangents = normalize(axis[:, None] + around, dim=2)
    lobes = gaussian(torch.einsum("nmi,ni->nm", tangents, light + view), VARIANCE).mean(1)
    found = fiber_frame(FRAME, maps_of(tangents), light, view)
    alone = fiber_frame(FRAME, maps_of(axis[:, None]), light, view)
    error, unspread = ((x[:, 0] - lobes).abs().max() for x in (found, alone))
    assert error < 0.1 < 0.5 < unspread
    torch.testing.assert_close(found[:, 2:5], alone[:, 2:5], atol=0.02, rtol=0)


def test_two_directions_share_a_lobe_by_their_moments() -> None:
    """Of 0.9 x and 0.1 y, the axis is x, and h·y has the variance 0.1 of its square about it."""
    tangents = torch.tensor([[1.0, 0.0, 0.0]] * 9 + [[0.0, 1.0, 0.0]], dtype=torch.float64)
    light, view = units(N, seed=6), units(N, seed=7)
    found = fiber_frame(FRAME, maps_of(tangents.expand(N, 10, 3), 0.3), light, view)
    x, y = (light + view)[:, 0], (light + view)[:, 1]
    wanted = 0.3 * gaussian(x, VARIANCE + 0.1 * y**2)
    torch.testing.assert_close(found[:, 0], wanted, atol=1e-5, rtol=1e-4)


def test_gaps_have_no_lobe_and_finite_angles() -> None:
    light, view = units(N, seed=1), units(N, seed=2)
    found = fiber_frame(FRAME, torch.zeros(N, 7, dtype=torch.float64), light, view)
    assert found.isfinite().all()
    assert not found[:, [0, 2, 3, 4, 5]].any()


@pytest.mark.skipif(library.kernel() is None, reason=library.missing_reason() or "kernel")
@pytest.mark.parametrize("places", [1, 4])
def test_the_kernel_gives_the_numbers_of_pytorch(places: int, monkeypatch: pytest.MonkeyPatch) -> None:
    lattice = Lattice(4, 0.5)
    arrays = random_queries(np.random.default_rng(0), 2000, lattice)
    queries = [torch.from_numpy(arrays[name]) for name in ("u", "sigma", "omega_i", "omega_o")]
    known = rough_surface(lattice, glossy=False)
    compiled = compute_hints(known, *known_surface(places), FRAME, *queries)
    monkeypatch.setattr(hints, "kernel", lambda: None)
    plain = compute_hints(known, *known_surface(places), FRAME, *queries)
    assert compiled.shape == (2000, 13)
    torch.testing.assert_close(compiled, plain, atol=2e-4, rtol=2e-4)
