"""The compiled kernel of the hierarchical model against PyTorch: values, gradients, whole steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fit_data import random_directions
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig
from mbtf_fit.data.images import Patches, TrainingImages, nearest_shapes
from mbtf_fit.material.inference import predict
from mbtf_fit.models.encodings import encode_position
from mbtf_fit.models.hierarchical import Hierarchical
from mbtf_fit.models.registry import build_model
from mbtf_fit.native import library
from mbtf_fit.native.library import Kernel, variants
from mbtf_fit.native.model import NativeModel, supports_patches
from mbtf_fit.native.patches import PatchGradients
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.noise import NoiseModel
from mbtf_fit.objective.parallel import Workers
from mbtf_fit.training.trainer import Trainer

KERNEL = library.kernel()
pytestmark = pytest.mark.skipif(KERNEL is None, reason=f"compiled kernel: {library.missing_reason()}")
VARIANTS = list(variants(KERNEL.library)) if KERNEL is not None else ["none"]
CPU = torch.device("cpu")
LATTICE = Lattice(3, 0.5)
PAPER = {"direction_pi": True, "band_attenuation": False, "footprint_filtered": False}
PLAIN = {"position": 0, "direction": 0}


def kernel_of(variant: str) -> Kernel:
    assert KERNEL is not None
    return Kernel(KERNEL.library, variants(KERNEL.library)[variant], variant)


def random_model(lattice: Lattice = LATTICE, **network: Any) -> Hierarchical:
    """A model with random parameters, biases and offset texture included."""
    model = build_model("hierarchical", lattice, **network)
    assert isinstance(model, Hierarchical)
    generator = torch.Generator().manual_seed(0)
    model.initialize(generator, 0.1)
    with torch.no_grad():
        for p in model.parameters():
            p += 0.1 * torch.randn(p.shape, generator=generator)
    return model


def random_queries(n: int, lattice: Lattice, seed: int = 0) -> tuple[Tensor, ...]:
    """Queries of all levels, at views down to the horizon, also outside the tile."""
    random = np.random.default_rng(seed)
    sigma = 0.5 * np.exp2(-(lattice.finest + 1) * random.random(n) + 0.5)
    view = random_directions(random, n)
    view[: n // 4] = (np.sqrt(1 - 1e-8), 0, 1e-4)
    arrays = 3 * random.random((n, 2)) - 1, sigma, random_directions(random, n), view
    return tuple(torch.from_numpy(np.asarray(a, np.float32)) for a in arrays)


def random_patches(model: Hierarchical, items: int, rows: int, columns: int, seed: int = 0) -> Patches:
    """Patches of texels of the nearest level, that wrap around the tile."""
    _, sigma, omega_i, omega_o = random_queries(items, model.lattice, seed)
    random = np.random.default_rng(seed + 1)
    down, across = (n + 2 * model.margin for n in (rows, columns))
    extent = nearest_shapes(model.lattice, sigma.numpy())
    u, v = random.random((2, items, 1))
    u = u + np.arange(across) / extent[:, 1:]
    v = v - np.arange(down) / extent[:, :1]
    shape = (items, down, across)
    grid = np.stack([np.broadcast_to(u[:, None], shape), np.broadcast_to(v[:, :, None], shape)], -1) % 1
    value = 0.3 * random.random((items, rows, columns, 3))
    return Patches(torch.from_numpy(grid).float(), sigma, omega_i, omega_o, torch.from_numpy(value).float())


def objective(lattice: Lattice = LATTICE, **training: Any) -> Objective:
    section = FitConfig.model_validate({"training": training}).training
    return Objective(section, NoiseModel.silent(0.1, lattice))


def in_double(batch: Patches) -> Patches:
    return Patches(*(getattr(batch, k).double() for k in ("u", "sigma", "omega_i", "omega_o", "value")))


def exact_gradients(
    model: Hierarchical, loss: Objective, batch: Patches
) -> tuple[Tensor, dict[Tensor, Tensor]]:
    """Loss and gradient by every parameter, by autograd in float64."""
    model.double()
    parameters, b = list(model.parameters()), in_double(batch)
    value = loss(model.evaluate_patches(b.u, b.sigma, b.omega_i, b.omega_o), b)
    gradients = torch.autograd.grad(value, parameters)
    model.float()
    return value.detach(), dict(zip(parameters, gradients, strict=True))


def gradients_of(
    computed: PatchGradients, loss: Objective, batch: Patches, threads: int = 1
) -> tuple[Tensor, dict[Tensor, Tensor]]:
    """The same by the kernel."""
    with Workers(CPU, threads, limit=threads) as workers:
        value = computed.compute(loss, batch, workers)
    textures = {t.texels: g for t, g in zip(computed.model.textures(), computed.textures, strict=True)}
    return value, {p: g.clone() for p, g in (textures | computed.weights()).items()}


def assert_alike(model: Hierarchical, found: dict[Tensor, Tensor], exact: dict[Tensor, Tensor]) -> None:
    """All gradients are equal up to float32, of which some are small differences of large numbers."""
    assert found.keys() == set(model.parameters())
    largest = max(float(g.norm()) for g in exact.values())
    for parameter, gradient in exact.items():
        difference = float((found[parameter].double() - gradient).norm())
        assert difference <= 3e-4 * float(gradient.norm()) + 1e-6 * largest + 1e-9


def assert_gradients(
    model: Hierarchical, batch: Patches, loss: Objective, variant: str = VARIANTS[0], threads: int = 1
) -> None:
    computed = PatchGradients(NativeModel(kernel_of(variant), model))
    exact_loss, exact = exact_gradients(model, loss, batch)
    value, found = gradients_of(computed, loss, batch, threads)
    torch.testing.assert_close(value.double(), exact_loss, rtol=1e-5, atol=1e-8)
    assert_alike(model, found, exact)


@pytest.mark.parametrize("variant", VARIANTS)
@settings(max_examples=12, deadline=None)
@given(
    finest=st.integers(0, 4),
    aspect=st.sampled_from([1.0, 0.5, 2.3]),
    decoder=st.sampled_from(["inception", "inception", "mlp"]),
    channels=st.integers(1, 10),
    width=st.integers(9, 40),
    layers=st.integers(3, 6),
    items=st.integers(1, 40),
    rows=st.integers(1, 9),
    columns=st.integers(1, 9),
    offset=st.sampled_from(["depth", "none"]),
    output=st.sampled_from(["fourth-root", "expm1"]),
    encoding=st.sampled_from([{}, PLAIN, {"position": 4, "direction_xyz": True}]),
)
def test_values_and_gradients_are_those_of_the_reference(
    variant: str,
    finest: int,
    aspect: float,
    decoder: str,
    channels: int,
    width: int,
    layers: int,
    items: int,
    rows: int,
    columns: int,
    offset: str,
    output: str,
    encoding: dict[str, Any],
) -> None:
    lattice = Lattice(finest, aspect)
    model = random_model(
        lattice,
        decoder=decoder,
        channels=channels,
        width=width,
        layers=layers,
        offset=offset,
        output_transform=output,
        encoding=encoding,
    )
    assert supports_patches(model)
    queries = random_queries(items, lattice)
    with torch.no_grad():
        exact = model.double()(*(t.double() for t in queries)).clamp_min(0)
        model.float()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mbtf_fit.material.inference.kernel", lambda: kernel_of(variant))
        found = torch.from_numpy(predict(model, *(t.numpy() for t in queries)))
    assert float((found - exact).norm()) <= 1e-4 * float(exact.norm()) + 1e-7
    assert_gradients(model, random_patches(model, items, rows, columns), objective(lattice), variant)


@pytest.mark.parametrize("variant", VARIANTS)
def test_unfiltered_encodings_are_those_of_the_reference(variant: str) -> None:
    """Ten bands without attenuation: the highest have a thousand periods per tile."""
    u = torch.rand(7, 5, 5, 2)
    with torch.no_grad():
        # The first layer passes the encoding on to the answer.
        model = random_model(encoding=PAPER, decoder="mlp", layers=2, output_transform="expm1", offset="none")
        expected = encode_position(u.double(), torch.zeros(7, 5, 5), 0.5, model.network.encoding)
        for k in range(expected.shape[-1]):
            for p in model.decoder.parameters():
                p.zero_()
            model.decoder[0].weight[0, model.network.channels + k] = 1.0
            model.decoder[0].bias[0] = 1.0
            model.decoder[1].weight[:, 0] = 1.0
            found = predict(model, *(t.numpy() for t in (u.view(-1, 2), *random_queries(175, LATTICE)[1:])))
            value = 0.1 * torch.expm1(expected[..., k].flatten() + 1)
            np.testing.assert_allclose(found[:, 0], value.numpy(), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("size", [1, 4, 20, 33])
def test_patches_of_any_size(size: int) -> None:
    """From many patches per group to several blocks per patch, on two threads."""
    model = random_model()
    batch = random_patches(model, max(2, 600 // size**2), size, size)
    assert_gradients(model, batch, objective(), threads=2)


def test_other_losses_go_through_pytorch_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbtf_fit.native.patches._PIECE_BYTES", 1)
    for decoder in ("inception", "mlp"):
        model = random_model(decoder=decoder)
        loss = objective(losses=[{"kind": "fourth-root"}, {"kind": "gradient"}], correction="none")
        assert loss.quadratic() is None
        assert_gradients(model, random_patches(model, 61, 5, 7), loss)


def test_shapes_may_change_between_batches() -> None:
    """The memory of an earlier batch does not matter, nor that of a group with more patches."""
    model = random_model()
    computed = PatchGradients(NativeModel(kernel_of(VARIANTS[0]), model))
    for items, size in ((40, 4), (3, 20), (40, 4), (90, 1), (31, 4)):
        batch, loss = random_patches(model, items, size, size, items), objective()
        _, exact = exact_gradients(model, loss, batch)
        assert_alike(model, gradients_of(computed, loss, batch)[1], exact)


def test_equal_maxima_pass_the_gradient_to_the_first() -> None:
    """Features that depend on nothing but texels of a constant row: neighbors in a row are equal."""
    model = random_model(Lattice(3), encoding=PLAIN, offset="none", layers=3)
    with torch.no_grad():
        for s, (rows, columns) in enumerate(model.pyramid.packing.shapes):
            start = model.pyramid.packing.starts[s]
            texels = model.pyramid.texels[start : start + rows * columns].view(rows, columns, -1)
            texels.copy_(texels[:, :1].clone().expand_as(texels))
    batch = random_patches(model, 9, 6, 6)
    # Whole texels apart at their centers, so that rounding does not break the ties.
    u = (torch.arange(10) + 0.5) / 8
    grid = torch.stack(torch.broadcast_tensors(u, 1 - u[:, None]), -1) % 1
    batch = Patches(
        grid.expand(9, -1, -1, -1), torch.full((9,), 0.5 / 8), batch.omega_i, batch.omega_o, batch.value
    )
    with torch.no_grad():
        x = model.read_features(batch.u, batch.sigma, batch.omega_o)
        assert torch.equal(x[:, :, :-1], x[:, :, 1:])
    assert_gradients(model, batch, objective())


def test_threads_change_rounding_only_and_reproducibly() -> None:
    model, loss = random_model(), objective()
    batch = random_patches(model, 50, 6, 6)
    native = NativeModel(kernel_of(VARIANTS[0]), model)
    found = [gradients_of(PatchGradients(native), loss, batch, threads) for threads in (1, 2, 2, 3)]
    for p in model.parameters():
        assert torch.equal(found[1][1][p], found[2][1][p])
    for other in (found[1], found[3]):
        assert_alike(model, other[1], {p: g.double() for p, g in found[0][1].items()})
    # More threads than patches: some have nothing to do.
    assert_gradients(model, random_patches(model, 2, 6, 6), loss, threads=3)


def images(count: int, size: int) -> TrainingImages:
    """Images of random values."""
    model = random_model(decoder="mlp")
    p = random_patches(model, count, size, size)
    extent = nearest_shapes(LATTICE, p.sigma.numpy())
    return TrainingImages(p.u, p.sigma, p.omega_i, p.omega_o, p.value, np.ones((count, 2), np.int64), extent)


@pytest.mark.parametrize("decoder", ["inception", "mlp"])
def test_training_equals_that_of_pytorch(decoder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options = {"steps": 4, "batch": 1000, "warmup": 0, "patch_size": 5, "texture_weight_decay": 0.1}
    config = FitConfig.model_validate(
        {"model": "hierarchical", "network": {"decoder": decoder}, "training": options}
    )

    def trained() -> Trainer:
        model = build_model("hierarchical", LATTICE, **config.network.model_dump())
        model.initialize(torch.Generator().manual_seed(0), 0.1)
        trainer = Trainer(config, model, images(60, 8), NoiseModel.silent(0.1, LATTICE))
        trainer.train(60)
        return trainer

    mine = trained()
    monkeypatch.setattr("mbtf_fit.training.trainer.kernel", lambda: None)
    theirs = trained()
    assert [t.backend.split()[0] for t in (mine, theirs)] == ["kernel", "pytorch"]
    assert mine.progress.loss == pytest.approx(theirs.progress.loss, rel=1e-4)
    for a, b in zip(mine.model.parameters(), theirs.model.parameters(), strict=True):
        # Adam turns rounding errors of small gradients into steps of full size, here and there.
        assert float((a - b).detach().norm()) <= 0.03 * float(b.detach().norm()) + 1e-6


@pytest.mark.parametrize("name", [0, 2, 3])  # a footprint that is no number has no neighborhood
def test_nan_stays_in_its_query(name: int) -> None:
    model = random_model()
    arrays = [t.numpy() for t in random_queries(50, LATTICE)]
    good = predict(model, *arrays)
    arrays[name][7] = np.nan
    found = predict(model, *arrays)
    assert np.isnan(found[7]).all()
    rest = np.arange(50) != 7
    np.testing.assert_array_equal(found[rest], good[rest])
    assert predict(model, *(a[:0] for a in arrays)).shape == (0, 3)


def test_unsupported_options_use_pytorch() -> None:
    options: list[dict[str, Any]] = [
        *({"activation": "leaky-relu"}, {"output_channels": 6}, {"output_transform": "exp"}),
        *({"offset": "direct"}, {"blending": "concatenate"}, {"width": 129}),
        *({"encoding": {"pi": False}}, {"encoding": {"raw": True}}),
    ]
    for option in options:
        assert not supports_patches(build_model("hierarchical", LATTICE, **option)), option
    assert not supports_patches(build_model("neumip", LATTICE))
    assert not supports_patches(build_model("hierarchical", LATTICE).double())
    assert supports_patches(
        build_model("hierarchical", LATTICE, encoding={"direction": 2, "half_vector": True})
    )
