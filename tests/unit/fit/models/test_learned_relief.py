"""The model that learns heights: gradients, kernel, the surface that rays see."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import parallax, random_queries, training_queries
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit import FitConfig
from mbtf_fit.backends.cpu.gradients import NativeGradients
from mbtf_fit.backends.cpu.model import NativeModel, supports
from mbtf_fit.config import build_model
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.models import learned_relief
from mbtf_fit.models.learned_relief import FILTERED, FILTERED_LEAST, TRACED, LearnedRelief
from mbtf_fit.native import library
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import Workers
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


def batch_of(hooks: LearnedRelief, n: int = 700) -> TrainingQueries:
    arrays = random_queries(np.random.default_rng(0), n, LATTICE)
    arrays["u"] = (5 * arrays["u"] - 2).astype(np.float32)
    batch = training_queries(arrays, parallax(*arrays.values()))
    at = batch.u, batch.sigma, batch.omega_i, batch.omega_o
    return replace(batch, hints=hooks.material.hints(*at))


def queries_of(batch: TrainingQueries) -> list[Tensor]:
    assert batch.hints is not None
    return [batch.u, batch.sigma, batch.omega_i, batch.omega_o, batch.hints]


@pytest.mark.skipif(library.kernel() is None, reason=library.missing_reason() or "kernel")
def test_kernel_and_pytorch_agree() -> None:
    """Gradients by texels, heights, depth weights and layers; some denominators are at their bound."""
    hooks, found = model_of(4.0), library.kernel()
    model: Any = hooks.material
    assert found is not None
    assert supports(model)
    batch = batch_of(hooks)
    objective = Objective(FitConfig().training, NoiseModel.silent(0.1, LATTICE))
    texels, weights = model.parameter_groups()
    loss = objective(model(*queries_of(batch)), batch)
    by_texels, by_heights, *by_weights = torch.autograd.grad(loss, [*texels, *weights])
    gradients = NativeGradients(NativeModel(found, model))
    with Workers(torch.device("cpu")) as workers:
        native = gradients.compute(objective, batch, workers)
    assert float(native) == pytest.approx(float(loss.detach()), rel=1e-5)
    names = [name for name, _ in model.named_parameters() if not name.endswith("texels")]
    layers = iter(gradients.networks[0])
    mine = [gradients.depth_weights[:5] if name == "depth_weights" else next(layers) for name in names]
    assert float(by_heights.abs().max()) > 0
    pairs = zip([by_texels, by_heights, *by_weights], [*gradients.textures, *mine], strict=True)
    for label, (a, b) in zip(["texels", "heights", *names], pairs, strict=True):
        assert float((a - b).abs().max()) < 1e-4 * float(a.abs().max()), label


def test_the_gradient_by_heights_moves_lookups_as_tracing_does() -> None:
    """On a surface without occlusion, against rays that are traced again after a change of the heights."""
    hooks = model_of(0.2, smooth=True)
    model: Any = hooks.material
    batch = batch_of(hooks, 10_000)
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
    batch = batch_of(hooks, 100)
    wanted = -(0.04 + 0.24 * HEIGHT_SCALE) * batch.omega_o[:, :2] / batch.omega_o[:, 2:]
    torch.testing.assert_close(model.offset(batch.u, batch.omega_o), wanted, atol=1e-5, rtol=1e-4)
    assert batch.hints is not None
    # Nothing hides the light: the irradiance is that of the reference plane.
    high = batch.omega_i[:, 2] > 0.2
    torch.testing.assert_close(batch.hints[high, 1], torch.ones(int(high.sum())), atol=1e-4, rtol=0)


def test_rays_follow_the_heights_before_normals_and_horizons() -> None:
    hooks = model_of()
    model: Any = hooks.material
    first = model.known
    with torch.no_grad():
        model.heights.texels -= 0.1
    hooks.follow(TRACED + 1, 0.0)
    assert model.known is first
    hooks.follow(TRACED, 0.0)
    assert float((model.known.heights - first.heights).max()) == pytest.approx(-0.1 * HEIGHT_SCALE, rel=1e-3)
    assert model.known.maps is first.maps
    hooks.follow(FILTERED, 0.0)
    assert model.known.maps is not first.maps


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


def test_short_fits_filter_normals_and_horizons_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_relief, "FILTERED", 10**6)
    hooks = model_of()
    model: Any = hooks.material
    seen = []
    for step in range(1, 100):
        before = model.known.maps
        hooks.follow(step, 0.0, step / 100)
        seen += [step] if model.known.maps is not before else []
    assert len(seen) == FILTERED_LEAST - 1
    assert seen[-1] < 90


def test_heights_start_from_those_of_another_material() -> None:
    first, second = model_of(), model_of()
    texels = first.material.texture("heights").texels
    with torch.no_grad():
        texels -= torch.rand(texels.shape)
    first.follow(0, 0.0)
    second.init_from(first.material)
    mine, theirs = (hooks.material.known.heights for hooks in (second, first))
    assert torch.equal(mine, theirs)
    # The next step of training goes on from there.
    second.follow(0, 0.0)
    torch.testing.assert_close(second.material.known.heights, theirs, atol=1e-6, rtol=0)


def test_the_surface_is_restored() -> None:
    """Also where rays see newer heights than normals and horizons were filtered from."""
    hooks = model_of()
    model: Any = hooks.material
    with torch.no_grad():
        model.heights.texels -= 0.1 * torch.rand(model.heights.texels.shape)
    hooks.follow(TRACED, 0.0)
    again = hooks_of(LATTICE)
    again.restore({name: tensor.clone() for name, tensor in hooks.state().items()})
    for name, tensor in model.known.tensors().items():
        assert torch.equal(again.material.known.tensors()[name], tensor), name


def test_a_material_stores_the_surface_alone() -> None:
    hooks = model_of()
    model: Any = hooks.material
    tensors = model.weights()
    assert "surface.heights" in tensors
    assert not [name for name in tensors if name.startswith("heights")]
    again = build_model("neumip+", LATTICE)
    again.load_weights(tensors)
    arrays = queries_of(batch_of(hooks, 50))[:4]
    torch.testing.assert_close(again(*arrays), model(*arrays), atol=0, rtol=0)
