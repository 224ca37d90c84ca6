"""The compiled kernel against PyTorch: values, gradients, blur, Adam, whole steps; where it is missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fit_data import parallax, random_queries, training_queries
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit.backends.cpu.gradients import NativeGradients, query_pointers
from mbtf_fit.backends.cpu.model import NativeModel, supports
from mbtf_fit.backends.cpu.stepper import Blur, Sums, adam
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.material.inference import evaluate_in_chunks, predict
from mbtf_fit.native import library
from mbtf_fit.native.library import Kernel, variants
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.pytorch.residuals import summed

KERNEL = library.kernel()
needs_kernel = pytest.mark.skipif(KERNEL is None, reason=f"compiled kernel: {library.missing_reason()}")
VARIANTS = list(variants(KERNEL.library)) if KERNEL is not None else ["none"]
CPU = torch.device("cpu")
LATTICE = Lattice(3)


def kernel_of(variant: str) -> Kernel:
    assert KERNEL is not None
    return Kernel(KERNEL.library, variants(KERNEL.library)[variant], variant)


def random_model(name: str, lattice: Lattice, **network: Any) -> NeuralMaterial:
    """A model with random parameters, biases and offset texture included; some values are at the bound."""
    model = build_model(name, lattice, **network)
    generator = torch.Generator().manual_seed(0)
    model.initialize(generator, 0.1, 1.0)
    with torch.no_grad():
        for p in model.parameters():
            p += 0.1 * torch.randn(p.shape, generator=generator)
    return model


def random_batch(n: int, lattice: Lattice = LATTICE, seed: int = 0) -> TrainingQueries:
    arrays = random_queries(np.random.default_rng(seed), n, lattice)
    # All over the plane: textures repeat.
    arrays["u"] = (5 * arrays["u"] - 2).astype(np.float32)
    return training_queries(arrays, parallax(*arrays.values()))


def in_double(batch: TrainingQueries) -> TrainingQueries:
    return TrainingQueries(*(t.double() for t in (*inputs_of(batch), batch.value)))


def inputs_of(batch: TrainingQueries) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return batch.u, batch.sigma, batch.omega_i, batch.omega_o


def objective(lattice: Lattice = LATTICE, **training: Any) -> Objective:
    section = FitConfig.model_validate({"training": training}).training
    noise = replace(NoiseModel.silent(0.1, lattice), overall=np.array([0.3, 0.2, 0.1]))
    return Objective(section, noise)


def kernel_gradients(
    variant: str, model: NeuralMaterial, loss: Objective, batch: TrainingQueries, threads: int = 1
) -> tuple[Tensor, dict[Tensor, Tensor]]:
    """Loss and gradient by every parameter."""
    with Workers(CPU, threads, limit=threads) as workers:
        gradients = NativeGradients(NativeModel(kernel_of(variant), model))
        value = gradients.compute(loss, batch, workers)
    native = gradients.native
    found = dict(zip((t.texels for t in native.textures), gradients.textures, strict=True))
    for network, mine in zip(native.networks, gradients.networks, strict=True):
        found |= dict(zip(network.parameters(), mine, strict=True))
    return value, {p: g.clone() for p, g in found.items()}


def exact_gradients(
    model: NeuralMaterial, loss: Objective, batch: TrainingQueries
) -> tuple[Tensor, list[Tensor]]:
    """The same by autograd in float64."""
    model.double()
    parameters = list(model.parameters())
    queries = in_double(batch)
    value = loss(model(*inputs_of(queries)), queries)
    gradients = torch.autograd.grad(value, parameters)
    model.float()
    return value.detach(), list(gradients)


def _index(model: NeuralMaterial) -> int:
    """Number of the parameter that is the decoder's last bias."""
    last = list(model.decoder.parameters())[-1]
    return next(k for k, p in enumerate(model.parameters()) if p is last)


def assert_alike(found: Tensor, exact: Tensor, tolerance: float = 1e-4, floor: float = 1e-9) -> None:
    """Equal up to float32, measured by the whole tensor's size."""
    difference = float((found.double() - exact).norm())
    assert difference <= tolerance * float(exact.norm()) + floor


def assert_gradients_alike(model: NeuralMaterial, found: dict[Tensor, Tensor], exact: list[Tensor]) -> None:
    """The same for the gradients by all parameters, of which some are small differences of large numbers."""
    largest = max(float(g.norm()) for g in exact)
    for parameter, gradient in zip(model.parameters(), exact, strict=True):
        assert_alike(found[parameter], gradient, floor=1e-6 * largest)


@needs_kernel
@pytest.mark.parametrize("variant", VARIANTS)
@settings(max_examples=12)
@given(
    name=st.sampled_from(["neumip", "neumip-baseline"]),
    lattice=st.builds(Lattice, st.integers(0, 4), st.sampled_from([1.0, 0.5, 0.6, 2.3])),
    sizes=st.fixed_dictionaries(
        {"channels": st.integers(1, 19), "width": st.integers(1, 40), "layers": st.integers(2, 5)}
    ),
    n=st.integers(1, 300),
    kind=st.sampled_from(["relative", "squared", "chroma"]),
    huber_delta=st.sampled_from([None, 0.5]),
    direction_xyz=st.booleans(),
)
def test_values_and_gradients_are_those_of_the_reference(
    variant: str,
    name: str,
    lattice: Lattice,
    sizes: dict[str, int],
    n: int,
    kind: str,
    huber_delta: float | None,
    direction_xyz: bool,
) -> None:
    model = random_model(name, lattice, **sizes, encoding={"direction_xyz": direction_xyz})
    batch = random_batch(n, lattice)
    with torch.no_grad():
        exact = model.double()(*inputs_of(in_double(batch)))
        model.float()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mbtf_fit.material.inference.kernel", lambda: kernel_of(variant))
        found = predict(model, *(t.numpy() for t in inputs_of(batch)))
    assert_alike(torch.from_numpy(found), exact.clamp_min(0), 1e-5)
    terms = [{"kind": kind, "weight": 0.7}, {"kind": "relative", "weight": 0.1}]
    loss = objective(lattice, losses=terms, huber_delta=huber_delta)
    exact_loss, expected = exact_gradients(model, loss, batch)
    value, gradients = kernel_gradients(variant, model, loss, batch)
    torch.testing.assert_close(value.double(), exact_loss, rtol=1e-5, atol=1e-8)
    assert_gradients_alike(model, gradients, expected)


@needs_kernel
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_largest_networks_are_those_of_the_reference(variant: str) -> None:
    """The largest supported numbers of channels, features and layers."""
    model = random_model("neumip", LATTICE, channels=64, width=128, layers=16)
    assert supports(model)
    with torch.no_grad():
        for network in model.networks().values():
            # So many random layers would overflow exp.
            network.weights[-1] *= 1e-3
    batch, loss = random_batch(200), objective()
    exact_loss, expected = exact_gradients(model, loss, batch)
    value, gradients = kernel_gradients(variant, model, loss, batch)
    torch.testing.assert_close(value.double(), exact_loss, rtol=1e-4, atol=1e-8)
    assert_gradients_alike(model, gradients, expected)


@needs_kernel
@pytest.mark.parametrize("variant", VARIANTS)
def test_outputs_of_any_size_give_finite_values(variant: str) -> None:
    """exp(x) - 1 and its slope to single precision, from underflow to overflow and near 0."""
    model = build_model("neumip-baseline", LATTICE, layers=2)
    small = 10.0 ** np.arange(-9, 1)
    answers = np.concatenate([[-200, -87.1, 88.2, 88.8, 200], np.linspace(-86.9, 88.2, 66), small, -small])
    native, batch = NativeModel(kernel_of(variant), model), random_batch(1)
    loss = objective(losses=[{"kind": "squared"}], huber_delta=None)
    with torch.no_grad():
        model.number("most").fill_(torch.inf)
        for p in model.parameters():
            p.zero_()
    for x in torch.from_numpy(answers.astype(np.float32)).view(-1, 1).expand(-1, 3):
        with torch.no_grad():
            list(model.decoder.parameters())[-1].copy_(x)
        native.refresh()
        found = torch.empty(1, 3)
        native.forward(query_pointers(batch, 0, 1), native.state(1), found.data_ptr())
        exact = torch.expm1(x.double())[None]
        # Infinite a little early.
        torch.testing.assert_close(found.double(), torch.where(x > 88.3, torch.inf, exact), rtol=3e-7, atol=0)
        if abs(float(x[0])) < 20:
            _, expected = exact_gradients(model, loss, batch)
            _, gradients = kernel_gradients(variant, model, loss, batch)
            mine = gradients[list(model.decoder.parameters())[-1]].double()
            # The slope is good to 2e-7, of which the loss makes some hundred times as much.
            torch.testing.assert_close(mine, expected[_index(model)], rtol=1e-5, atol=2e-5)


@needs_kernel
@pytest.mark.parametrize("kind", ["log", "fourth-root"])
def test_other_losses_go_through_pytorch_in_pieces(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbtf_fit.backends.cpu.gradients._PIECE_BYTES", 1)
    model, batch = random_model("neumip", LATTICE), random_batch(1500)
    loss = objective(losses=[{"kind": kind, "weight": 1.0}, {"kind": "relative", "weight": 0.5}])
    assert loss.quadratic() is None
    exact_loss, expected = exact_gradients(model, loss, batch)
    value, gradients = kernel_gradients(VARIANTS[0], model, loss, batch, 2)
    torch.testing.assert_close(value.double(), exact_loss, rtol=1e-5, atol=1e-8)
    assert_gradients_alike(model, gradients, expected)


@needs_kernel
def test_threads_change_rounding_only_and_reproducibly() -> None:
    model, batch, loss = random_model("neumip", LATTICE), random_batch(1999), objective()
    found = [kernel_gradients(VARIANTS[0], model, loss, batch, threads) for threads in (1, 2, 2, 3)]
    for p in model.parameters():
        assert torch.equal(found[1][1][p], found[2][1][p])
        for other in (found[1], found[3]):
            assert_alike(other[1][p], found[0][1][p].double(), 1e-5)
    assert found[1][0] == found[2][0]
    # More threads than queries: some have nothing to do.
    few = random_batch(2)
    one, three = (kernel_gradients(VARIANTS[0], model, loss, few, threads) for threads in (1, 3))
    torch.testing.assert_close(one[0], three[0])
    for p in model.parameters():
        assert_alike(three[1][p], one[1][p].double(), 1e-5)


@needs_kernel
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(("aspect", "sigma"), [(1.0, 8.0), (1.0, 0.6), (0.6, 3.0), (2.0, 20.0)])
def test_blur_is_that_of_the_reference(variant: str, aspect: float, sigma: float) -> None:
    model = random_model("neumip", Lattice(6, aspect), channels=5)
    for texture in model.textures():
        with Workers(CPU, 2, limit=2) as workers:
            table, found = texture.texels.detach(), torch.empty_like(texture.texels)
            Blur(kernel_of(variant), texture, sigma).apply(table, torch.empty_like(table), found, workers)
        torch.testing.assert_close(found, texture.blurred(sigma).detach(), rtol=1e-5, atol=1e-6)


@needs_kernel
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("aspect", [1.0, 0.7, 1.5])
def test_sums_of_levels_are_those_of_the_reference(variant: str, aspect: float) -> None:
    (texture, *_) = random_model("relief", Lattice(6, aspect), channels=5).textures()
    kernel, residuals = kernel_of(variant), texture.texels.detach().requires_grad_()
    expected = summed(residuals, texture.packing)
    gradient = torch.randn_like(expected)
    (transposed,) = torch.autograd.grad(expected, residuals, gradient)
    with Workers(CPU, 2, limit=2) as workers:
        found = residuals.detach().clone()
        Sums(kernel, texture).apply(found, workers)
        Sums(kernel, texture).apply_transposed(gradient, workers)
    torch.testing.assert_close(found, expected.detach(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(gradient, transposed, rtol=1e-5, atol=1e-5)


@needs_kernel
@pytest.mark.parametrize("variant", VARIANTS)
def test_adam_equals_pytorchs_and_resumes_its_state(variant: str) -> None:
    torch.manual_seed(0)
    start = [torch.randn(3, 5), torch.randn(20_001)]
    sides = [[torch.nn.Parameter(t.clone()) for t in start] for _ in range(2)]
    groups = [[{"params": p, "lr": 10.0**-k} for k, p in enumerate(side, 1)] for side in sides]
    mine, theirs = (torch.optim.Adam(g, betas=(0.8, 0.95), fused=True) for g in groups)
    for step in range(6):
        gradients = [torch.randn_like(t) * 10.0 ** (-step) for t in start]
        for p, g in zip(sides[1], gradients, strict=True):
            p.grad = g
        theirs.step()
        if step == 3:  # PyTorch takes a turn.
            for p, g in zip(sides[0], gradients, strict=True):
                p.grad = g
            mine.step()
            continue
        with Workers(CPU, 2, limit=2) as workers:
            adam(kernel_of(variant), mine, dict(zip(sides[0], gradients, strict=True)), workers)
    for a, b in zip(*sides, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
        assert mine.state[a]["step"] == theirs.state[b]["step"] == 6


@needs_kernel
def test_many_queries_are_evaluated_by_all_threads_alike() -> None:
    model, batch = random_model("neumip", LATTICE), random_batch(20_000)
    arrays = [t.numpy() for t in inputs_of(batch)]
    plain = evaluate_in_chunks(lambda *a: model(*a).clamp_min(0), CPU, 3, *arrays)
    np.testing.assert_allclose(predict(model, *arrays), plain, rtol=1e-4, atol=1e-5)
    some = predict(model, *(a[:77] for a in arrays))
    np.testing.assert_array_equal(some, predict(model, *arrays)[:77])
    assert predict(model, *(a[:0] for a in arrays)).shape == (0, 3)


@needs_kernel
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("name", ["u", "sigma", "omega_i", "omega_o"])
def test_nan_does_not_read_outside_the_tables(bad: float, name: str) -> None:
    model = random_model("neumip", LATTICE)
    arrays = random_queries(np.random.default_rng(0), 200, LATTICE)
    good = predict(model, *arrays.values())
    arrays[name][7] = bad
    found = predict(model, *arrays.values())
    if np.isnan(bad):
        assert np.isnan(found[7]).all()
    rest = np.arange(200) != 7
    np.testing.assert_array_equal(found[rest], good[rest])


def test_unsupported_options_use_pytorch() -> None:
    options: list[dict[str, Any]] = [
        *({"activation": "leaky-relu"}, {"output_channels": 6}, {"output_transform": "exp"}),
        *({"offset": "direct"}, {"width": 129}, {"layers": 16, "width": 500}),
        *({"encoding": {"position": 2}}, {"encoding": {"direction": 1}}),
    ]
    for option in options:
        model = build_model("neumip", LATTICE, **option)
        assert not supports(model), option
    for other in ("hierarchical", "quartesan2022"):
        assert not supports(build_model(other, LATTICE))
    assert not supports(build_model("neumip", LATTICE).double())
    known: list[dict[str, Any]] = [{"offset": "none"}, {"channels": 64, "width": 128, "layers": 16}]
    known.append({"encoding": {"direction_xyz": True}})
    for option in known:
        assert supports(build_model("neumip", LATTICE, **option))


@pytest.mark.parametrize("value", ["off", "z80"])
def test_without_a_kernel_pytorch_is_used(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(library.ENVIRONMENT, value)
    library.reload()
    try:
        assert library.kernel() is None
        assert "MBTF_KERNEL" in library.missing_reason() or KERNEL is None
        assert library.describe().startswith("PyTorch; compiled kernel: ")
        model, batch = random_model("neumip", LATTICE), random_batch(50)
        found = predict(model, *(t.numpy() for t in inputs_of(batch)))
        assert found.shape == (50, 3)
    finally:
        monkeypatch.undo()
        library.reload()
