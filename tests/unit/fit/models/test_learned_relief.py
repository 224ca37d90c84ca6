"""The model that learns heights: gradients, kernel, the surface that rays see."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from support.traced_gradients import assert_gradients_agree, needs_kernel, traced_batch
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import build_model
from mbtf_fit.models.learned_relief import LearnedRelief
from mbtf_fit.ops.constants import HEIGHT_SCALE

LATTICE, FINE = Lattice(4, 0.5), Lattice(7, 0.5)


def hooks_of(lattice: Lattice) -> LearnedRelief:
    return LearnedRelief(build_model("neumip+", lattice))


def model_of(steepness: float = 0.4, *, smooth: bool = False) -> LearnedRelief:
    """A model with random weights on random heights; smooth ones are waves of the tile's size, of more
    texels."""
    lattice = FINE if smooth else LATTICE
    hooks = hooks_of(lattice)
    model: Any = hooks.material
    generator = torch.Generator().manual_seed(0)
    model.initialize(generator, 0.1)
    rows, columns = lattice.shape()
    with torch.no_grad():
        for p in model.parameters():
            p += 0.1 * torch.randn(p.shape, generator=generator)
        if smooth:
            x = torch.arange(columns) * (2 * np.pi / columns)
            y = torch.arange(rows)[:, None] * (2 * np.pi / rows)
            model.heights.texels[:, 0] = (steepness * (torch.sin(x) * torch.cos(y) - 1)).reshape(-1)
        else:
            model.heights.texels.mul_(steepness)
    hooks.follow(0, 0.0)
    return hooks


@needs_kernel
def test_kernel_and_pytorch_agree() -> None:
    """Some denominators are at their bound."""
    model = model_of(4.0).material
    assert_gradients_agree(model, traced_batch(model))


def test_the_gradient_by_heights_moves_lookups_as_tracing_does() -> None:
    """On a surface without occlusion, against rays that are traced again after a change of the heights."""
    hooks = model_of(0.2, smooth=True)
    model: Any = hooks.material
    batch = traced_batch(model, 10_000)
    # Where the bounds of denominator and cosine do not matter, and the surface falls away from the viewer:
    # without its slope the gradient would be smaller by a tenth.
    x, y, z = batch.omega_o.unbind(1)
    falls = torch.cos(2 * np.pi * batch.u).prod(1) > 0.3
    seen = (z > 0.5) & (x > 0.2) & (y.abs() < 0.2) & falls
    u, sigma, omega_o = (a[seen] for a in (batch.u, batch.sigma, batch.omega_o))
    level = model.level(sigma)
    # All lookups move away from the viewer; steeper ones by more.
    weight = omega_o[:, :2] / omega_o[:, 2:]
    # As smooth as the surface, so that both ways of interpolation agree.
    rows, columns = FINE.shape()
    change = torch.cos(torch.arange(columns) * (2 * np.pi / columns)).expand(rows, columns).reshape(-1, 1)
    change = change + 0.5

    def displaced() -> Tensor:
        height = model.known.tracer.trace(u, omega_o)[:, None]
        given = {"u": u, "level": level, "z": height, "omega_o": omega_o}
        (moved,) = model.run(["moved"], given)
        return (moved * weight).sum()

    (gradient,) = torch.autograd.grad(displaced(), model.heights.texels)
    predicted = float((gradient * change).sum())
    moved, size = [], 1e-3
    for sign in (1, -1):
        with torch.no_grad():
            model.heights.texels += sign * size * change
            hooks.follow(0, 0.0)
            moved.append(float(displaced()))
            model.heights.texels -= sign * size * change
    assert (moved[0] - moved[1]) / (2 * size) == pytest.approx(predicted, rel=0.01)


def test_a_flat_surface_is_displaced_by_its_depth() -> None:
    hooks = hooks_of(LATTICE)
    model: Any = hooks.material
    model.initialize(torch.Generator().manual_seed(0), 0.1)
    with torch.no_grad():
        model.heights.texels.fill_(-0.24)
        model.depth_weights.fill_(1.0)
    hooks.follow(0, 0.0)
    batch = traced_batch(model, 100)
    wanted = -(0.04 + 0.24 * HEIGHT_SCALE) * batch.omega_o[:, :2] / batch.omega_o[:, 2:]
    torch.testing.assert_close(model.offset(batch.u, batch.omega_o), wanted, atol=1e-5, rtol=1e-4)
    assert batch.hints is not None
    # Nothing hides the light: the irradiance is that of the reference plane.
    high = batch.omega_i[:, 2] > 0.2
    torch.testing.assert_close(batch.hints[high, 1], torch.ones(int(high.sum())), atol=1e-4, rtol=0)


def test_heights_stay_below_the_reference_plane() -> None:
    hooks = model_of()
    model: Any = hooks.material
    with torch.no_grad():
        model.heights.texels += 10
    # At any step, so that no texel has a gradient without an effect.
    hooks.follow(1, 0.0)
    assert float(model.heights.texels.detach().max()) == pytest.approx(0.04 / HEIGHT_SCALE)
    hooks.follow(0, 0.0)
    assert float(model.known.heights.max()) == pytest.approx(0, abs=1e-8)
    assert float(model.known.heights.max()) <= 0
