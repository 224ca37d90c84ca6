"""The models: weight counts, stages, offset, gradients, what they export."""

from __future__ import annotations

import pytest
import torch

from mbtf_fit.models import MODELS, build_model
from mbtf_fit.models.mlp import Mlp
from mbtf_fit.models.neumip import Neumip, NeumipBaseline
from mbtf_gen.errors import InputError
from mbtf_gen.levels import Lattice

F64 = torch.float64


def directions(n: int, lowest: float = 0.1) -> torch.Tensor:
    radius = ((1 - lowest**2) * torch.rand(n, dtype=F64)).sqrt()
    angle = 6.2831853 * torch.rand(n, dtype=F64)
    return torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - radius**2).sqrt()], 1)


def random_model(name: str, aspect: float = 1.0) -> NeumipBaseline:
    torch.manual_seed(0)
    model = build_model(name, Lattice(3, aspect)).double()
    assert isinstance(model, NeumipBaseline)
    model.initialise(torch.Generator().manual_seed(0), 0.1)
    if isinstance(model, Neumip):
        torch.nn.init.normal_(model.offset_texture.texels)
    return model


def test_weight_counts_are_the_papers() -> None:
    model = build_model("neumip", Lattice(7))
    assert isinstance(model, Neumip)
    assert model.decoder.count == 1678
    assert model.offset_network.count == 1576
    assert sum(p.numel() for p in model.parameter_groups()[1]) == 3254
    # The paper's own figure counts six outputs.
    assert Mlp([11, 25, 25, 25, 6]).count + Mlp([9, 25, 25, 25, 1]).count == 3332
    assert sum(p.numel() for p in model.parameter_groups()[0]) == 7 * (sum(4**s for s in range(8)) + 4**7)


def test_mlp_equals_its_reference() -> None:
    torch.manual_seed(0)
    network = Mlp([6, 25, 25, 3]).double()
    network.initialise(torch.Generator().manual_seed(1))
    x = torch.randn(100, 6, dtype=F64, requires_grad=True)
    weight = torch.randn(100, 3, dtype=F64)
    inputs = [x, *network.parameters()]
    fast, reference = network(x), network.reference(x)
    torch.testing.assert_close(fast, reference)
    gradients = [torch.autograd.grad((out * weight).sum(), inputs) for out in (fast, reference)]
    for mine, plain in zip(*gradients, strict=True):
        torch.testing.assert_close(mine, plain)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_agree_with_finite_differences(name: str) -> None:
    model = random_model(name, aspect=0.5)
    sigma = 0.5 * torch.exp2(-3 * torch.rand(6, dtype=F64))
    arguments = (torch.rand(6, 2, dtype=F64), sigma, directions(6), directions(6))
    names, parameters = zip(*model.named_parameters(), strict=True)

    def value(*tensors: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = torch.func.functional_call(
            model, dict(zip(names, tensors, strict=True)), arguments
        )
        return out

    assert torch.autograd.gradcheck(value, parameters, eps=1e-7, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_the_offset_follows_the_papers_formula() -> None:
    model = random_model("neumip")
    assert isinstance(model, Neumip)
    u, omega_o = torch.rand(50, 2, dtype=F64), directions(50)
    seen = torch.cat([model.offset_texture(u), omega_o[:, :2]], 1)
    r = 0.1 * model.offset_network.reference(seen)
    expected = r / omega_o[:, 2:].clamp_min(0.6) * omega_o[:, :2]
    torch.testing.assert_close(model.offset(u, omega_o), expected)
    straight = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(50, 3)
    assert model.offset(u, straight).abs().max() == 0


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_the_offset_is_a_length_in_tile_widths(aspect: float) -> None:
    model = random_model("neumip", aspect)
    u, omega_o = torch.rand(50, 2, dtype=F64), directions(50)
    sigma = torch.full((50,), 0.1, dtype=F64)
    moved = u + model.offset(u, omega_o) / torch.tensor([1.0, aspect], dtype=F64)
    plain = NeumipBaseline.stage1(model, moved, sigma, omega_o)
    torch.testing.assert_close(model.stage1(u, sigma, omega_o), plain)


def test_without_an_offset_texture_the_view_alone_decides() -> None:
    model = build_model("neumip-baseline", Lattice(3))
    assert model.offset(torch.rand(5, 2), torch.rand(5, 3)).abs().max() == 0


@pytest.mark.parametrize("name", MODELS)
def test_stage_one_does_not_see_the_light(name: str) -> None:
    model = random_model(name)
    u, sigma, view = torch.rand(9, 2, dtype=F64), torch.full((9,), 0.1, dtype=F64), directions(9)
    features = model.stage1(u, sigma, view)
    for _ in range(2):
        light = directions(9)
        torch.testing.assert_close(model.stage2(features, light, view), model(u, sigma, light, view))


@pytest.mark.parametrize("name", MODELS)
def test_exported_weights_make_the_same_model(name: str) -> None:
    model = random_model(name)
    for texture in model.textures():
        texture.read(texture.blurred(1.5))
    other = random_model(name)
    other.load_weights(model.weights())
    sigma = 0.5 * torch.exp2(-3 * torch.rand(20, dtype=F64))
    arguments = (torch.rand(20, 2, dtype=F64), sigma, directions(20), directions(20))
    torch.testing.assert_close(other(*arguments), model(*arguments), rtol=0, atol=0)
    weights = model.weights()
    weights.pop("decoder.0.bias")
    with pytest.raises(InputError, match=r"decoder\.0\.bias"):
        other.load_weights(weights)


@pytest.mark.parametrize("sigma", [0.0, 1e-9, 0.5, 3.0])
def test_footprints_beyond_the_levels_take_the_nearest(sigma: float) -> None:
    model = random_model("neumip-baseline")
    level = model.level(torch.tensor([sigma]))
    assert level.item() == (3.0 if sigma < 0.1 else 0.0)
