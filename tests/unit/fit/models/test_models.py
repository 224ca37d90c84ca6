"""The models: weight counts, stages, offset, gradients, options, what they export."""

from __future__ import annotations

from typing import Any, get_args

import pytest
import torch

from mbtf_core.config.settings import resolve
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import UsageError
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.ops import Lookup, Offset
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.sections import OutputTransform

F64, LATTICE = torch.float64, Lattice(3)


def of(model: str, **network: Any) -> tuple[str, dict[str, Any]]:
    return model, network


FILTERED = {"position": 3, "direction": 1, "footprint_filtered": True, "band_attenuation": True}
# Every option away from its default at least once, on the model that it is for.
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "baseline": of("neumip-baseline"),
    "neumip": of("neumip"),
    "six outputs": of("neumip", output_channels=6),
    "direct offset": of("neumip", offset="direct", activation="leaky-relu", output_transform="softplus"),
    "four levels": of("quartesan2022", output_transform="exp"),
    "encoded": of(
        "neumip", encoding={"position": 2, "direction": 2, "raw": True, "direction_xyz": True, "pi": False}
    ),
    "footprint_filtered": of("neumip", encoding=FILTERED),
    "identity": of("neumip-baseline", output_transform="identity", channels=3, width=8, layers=2),
    "hierarchical": of("hierarchical"),
    "hierarchical, one module": of("hierarchical", layers=3, offset="none", output_channels=6, width=12),
    "hierarchical, mlp": of("hierarchical", decoder="mlp"),
}
variants = pytest.mark.parametrize("variant", VARIANTS)


def directions(n: int, lowest: float = 0.1) -> torch.Tensor:
    radius = ((1 - lowest**2) * torch.rand(n, dtype=F64)).sqrt()
    angle = 6.2831853 * torch.rand(n, dtype=F64)
    return torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - radius**2).sqrt()], 1)


def random_model(variant: str, aspect: float = 1.0, finest: int = 3) -> NeuralMaterial:
    torch.manual_seed(0)
    name, options = VARIANTS[variant]
    model = build_model(name, Lattice(finest, aspect), **options).double()
    model.initialize(torch.Generator().manual_seed(0), 0.1)
    # Away from the kink of units that sum nothing but zeros.
    for name, parameter in model.named_parameters():
        if "bias" in name:
            torch.nn.init.normal_(parameter, 0.5, 0.2)
    for texture in model.textures():
        if texture.moves_lookups:
            torch.nn.init.normal_(texture.texels)
    return model


def encoded(
    value: str, u: torch.Tensor, level: torch.Tensor, aspect: float = 1.0, **options: Any
) -> torch.Tensor:
    """The encoded ``position`` or ``light`` of a model with these options."""
    model = build_model("neumip", Lattice(5, aspect), encoding=options).double()
    (found,) = model.run([value], {"u": u, "omega_i": u, "level": level})
    return found


def arguments(n: int) -> tuple[torch.Tensor, ...]:
    sigma = 0.5 * torch.exp2(-3 * torch.rand(n, dtype=F64))
    return torch.rand(n, 2, dtype=F64), sigma, directions(n), directions(n)


def test_weight_counts_are_the_papers() -> None:
    counts = {}
    for outputs in (3, 6):
        model = build_model("neumip", Lattice(7), output_channels=outputs)
        counts[outputs] = sum(p.numel() for p in model.parameter_groups()[1])
    # The paper's text describes three outputs, its figure counts six.
    assert counts == {3: 3254, 6: 3332}
    assert sum(p.numel() for p in model.parameter_groups()[0]) == 7 * (sum(4**s for s in range(8)) + 4**7)
    # 47 features (7 and 10 bands of u), 16 numbers per direction (4 bands of two coordinates).
    model = build_model("hierarchical", Lattice(7))
    modules = 2 * (26 * 7 + 26 * 3 + 28 * 12 + 26 * 5 + 3 * 126 + 26 * 3)
    assert sum(p.numel() for p in model.decoder.parameters()) == (47 + 32 + 1) * 25 + modules + 26 * 3


def test_unset_options_are_the_models_own() -> None:
    network = resolve(FitConfig, assignments=["model=hierarchical", "network.encoding.position=6"]).network
    assert (network.decoder, network.output_transform) == ("inception", "fourth-root")
    assert network.encoding.direction == 4
    assert network.encoding.position == 6
    dumped = FitConfig.model_validate({"model": "hierarchical", "network": {"decoder": "mlp"}})
    assert FitConfig.model_validate(dumped.model_dump(mode="json")) == dumped


@pytest.mark.parametrize(
    ("assignments", "words"),
    [
        (["model=neumip-baseline", "network.offset=depth"], "has no option network.offset"),
        (["model=neumip+", "network.relief.places=4"], "has no option network.relief.places"),
        (["model=neumip+", "network.relief.shadow_rays=true"], "has no option network.relief.shadow_rays"),
        (["network.decoder=inception"], "has no option network.decoder, which hierarchical has"),
    ],
)
def test_options_that_contradict_the_model_are_refused(assignments: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        resolve(FitConfig, assignments=assignments)


@variants
def test_gradients_agree_with_finite_differences(variant: str) -> None:
    """Of a random sum of the values, by each tensor along a random direction."""
    model = random_model(variant, aspect=0.5, finest=2)
    at = arguments(2)
    weight = torch.randn(2, 3, dtype=F64)

    def value() -> torch.Tensor:
        return (weight * model(*at)).sum()

    parameters = list(model.parameters())
    gradients = torch.autograd.grad(value(), parameters, allow_unused=True)
    with torch.no_grad():
        for p, gradient in zip(parameters, gradients, strict=True):
            start, direction, moved = p.clone(), torch.randn_like(p), []
            for step in (-1e-6, 1e-6):
                p.copy_(start + step * direction)
                moved.append(value())
            p.copy_(start)
            slope = torch.zeros(()) if gradient is None else (gradient * direction).sum()
            torch.testing.assert_close((moved[1] - moved[0]) / 2e-6, slope.double(), rtol=1e-4, atol=1e-7)


def test_the_offset_follows_the_papers_formula() -> None:
    model = random_model("neumip")
    u, omega_o = torch.rand(50, 2, dtype=F64), directions(50)
    seen = torch.cat([model.offset_texture(u), omega_o[:, :2]], 1)
    r = 0.1 * model.offset_network.reference(seen)
    expected = r / omega_o[:, 2:].clamp_min(0.6) * omega_o[:, :2]
    torch.testing.assert_close(model.offset(u, omega_o), expected)
    straight = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64).expand(50, 3)
    assert model.offset(u, straight).abs().max() == 0
    assert random_model("baseline").offset(u, omega_o).abs().max() == 0


@pytest.mark.parametrize(("depth", "lit"), [("depth", False), ("omega_i[0:1]", True)])
def test_an_offset_of_ones_own_is_that_of_the_finest_level(depth: str, lit: bool) -> None:
    """Its depths may have levels; where it depends on the light, there is not one."""
    operations = [
        Lookup("depth", "u", "level", "depths", 1),
        Offset("moved", "u", depth, "omega_o"),
        Lookup("value", "moved", "level", "texels", 3),
    ]
    model = NeuralMaterial(LATTICE, operations).double()
    for texture in model.textures():
        torch.nn.init.normal_(texture.texels)
    u, omega_o = torch.rand(50, 2, dtype=F64), directions(50)
    found = model.offset(u, omega_o)
    finest = torch.full((50,), float(LATTICE.finest), dtype=F64)
    (moved,) = model.run(["moved"], {"u": u, "level": finest, "omega_o": omega_o, "omega_i": omega_o})
    torch.testing.assert_close(found, torch.zeros_like(u) if lit else moved - u)
    assert (moved - u).abs().max() > 0.01


@variants
def test_stage_one_does_not_depend_on_the_light(variant: str) -> None:
    model = random_model(variant)
    u, sigma, view, _ = arguments(9)
    features = model.stage1(u, sigma, view)
    for _ in range(2):
        light = directions(9)
        torch.testing.assert_close(model.stage2(features, light, view), model(u, sigma, light, view))


@variants
def test_the_tile_repeats(variant: str) -> None:
    model = random_model(variant)
    if VARIANTS[variant][1].get("encoding", {}).get("pi") is False:
        pytest.skip("sin(2^k p) does not repeat with the tile")
    u, *rest = arguments(20)
    shift = torch.randint(-3, 4, u.shape).double()
    torch.testing.assert_close(model(u + shift, *rest), model(u, *rest))
    # ... and without a seam: both sides of it have the same value.
    left, right = u.clone(), u.clone()
    left[:, 0], right[:, 0] = 1 - 1e-9, 1e-9
    torch.testing.assert_close(model(left, *rest), model(right, *rest), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("output", get_args(OutputTransform))
def test_training_starts_from_the_datas_brightness(output: Any) -> None:
    model = build_model("neumip", LATTICE, output_transform=output).requires_grad_(False)
    model.initialize(torch.Generator().manual_seed(0), 0.3)
    start = list(model.decoder.parameters())[-1]
    (value,) = model.run(["value"], {"x": start[None]})
    torch.testing.assert_close(value, torch.full_like(value, 0.0 if output == "expm1" else 0.3))


def test_six_outputs_are_luma_chroma_and_a_gate() -> None:
    def value(x: torch.Tensor, transform: str) -> torch.Tensor:
        model = build_model("neumip", LATTICE, output_channels=6, output_transform=transform).double()
        model.unit.fill_(2.0)
        return model.run(["value"], {"x": x})[0]

    gray = torch.tensor([[0.7, 0.0, 0.0, 0.0, 20.0, -20.0]], dtype=F64)
    brightness = 2.0 * torch.expm1(torch.tensor(0.7, dtype=F64))
    expected = brightness * torch.tensor([[0.6, 1.1, 0.1]], dtype=F64)
    torch.testing.assert_close(value(gray, "expm1"), expected)
    red = torch.tensor([[0.0, 0.0, 1.0, 9.0, 9.0, 9.0]], dtype=F64)
    r, g, b = value(red, "identity")[0]
    assert r > 0 > g
    assert b == 0


def test_attenuated_bands_have_equal_slopes() -> None:
    options = {"position": 6, "direction": 4, "direction_pi": False, "band_attenuation": True}
    h, none = 1e-6, torch.zeros(1, dtype=F64)
    up, tilt = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64), torch.tensor([[h, h, 0.0]], dtype=F64)
    rise = encoded("light", up + tilt, none, **options) - encoded("light", up, none, **options)
    torch.testing.assert_close(rise[:, :8] / h, torch.ones(1, 8, dtype=F64))
    u, level = torch.full((2, 2), 0.5, dtype=F64), torch.zeros(2, dtype=F64)
    u[1] += h
    below, above = encoded("position", u, level, **options)
    torch.testing.assert_close((above - below)[:12] / h, torch.full((12,), 2 * torch.pi, dtype=F64))


def test_filtered_encodings_are_means_over_the_footprint() -> None:
    """Footprints are Gaussians of ``2^-level / 2`` tile widths; raw coordinates keep their own mean."""
    options = {"position": 4, "raw": True}
    aspect, u = 0.5, torch.tensor([[0.3, 0.6]], dtype=F64)
    z = torch.linspace(-8, 8, 8001, dtype=F64)
    weights = torch.exp(-0.5 * z**2)
    for level in (0.0, 1.5, 4.0):
        at = torch.full((1,), level, dtype=F64)
        sigma = 0.5 * 2.0**-level / torch.tensor([1.0, aspect], dtype=F64)
        around = encoded("position", u + z[:, None] * sigma, at.expand(len(z)), aspect, **options)
        expected = (weights[:, None] * around).sum(0) / weights.sum()
        found = encoded("position", u, at, aspect, **options, footprint_filtered=True)[0]
        torch.testing.assert_close(found[2:], expected[2:], atol=1e-9, rtol=0)
        torch.testing.assert_close(found[:2], 2 * u[0] - 1)


@variants
def test_initial_parameters_have_the_stated_distributions(variant: str) -> None:
    """Features of 0.1·N(0,1), no offset texture; variance-preserving weights."""
    name, options = VARIANTS[variant]
    model = build_model(name, Lattice(5), **{**options, "width": 128}).requires_grad_(False)
    model.initialize(torch.Generator().manual_seed(0), 0.2)
    assert float(model.unit) == pytest.approx(0.2)
    assert float(model.pyramid.texels.std()) == pytest.approx(0.1, rel=0.05)
    assert not any(t.texels.any() for t in model.textures() if t.moves_lookups)
    weights = model.weights()
    for network in ("decoder", "offset_network"):
        mine = [key for key in weights if key.startswith(network)]
        for key in mine:
            tensor, last = weights[key], key in mine[-2:]
            if not key.endswith(".bias"):
                variance = float(tensor.double().square().mean()) * tensor[0].numel()
                # Of so many numbers, to four standard errors.
                assert variance == pytest.approx(1 if last else 2, rel=4 * (2 / tensor.numel()) ** 0.5), key


def test_hierarchical_sees_nine_by_nine_texels_of_the_nearest_level() -> None:
    model = build_model("hierarchical", Lattice(4, 0.5)).double()
    assert model.positions == 81
    u = torch.tensor([[0.3, 0.7]], dtype=F64)
    for level, (rows, columns) in ((2.4, (2, 4)), (2.6, (4, 8)), (9.0, (8, 16))):
        sigma = torch.tensor([0.5 * 2.0**-level], dtype=F64)
        (grid,) = model.run(["grid"], {"u": u, "level": model.level(sigma)})
        places = grid.view(9, 9, 2)
        torch.testing.assert_close(places[4, 4], u[0])
        torch.testing.assert_close(places[4, 5] - places[4, 4], torch.tensor([1 / columns, 0.0], dtype=F64))
        torch.testing.assert_close(places[5, 4] - places[4, 4], torch.tensor([0.0, -1 / rows], dtype=F64))


def test_quartesan_reads_the_level_of_the_query_and_three_coarser_ones() -> None:
    """(Q1) Levels below the coarsest are the coarsest."""
    model = random_model("four levels")
    texture = model.textures()[0]
    starts = texture.packing.starts
    for s in range(4):
        texture.texels.data[starts[s] : starts[s + 1]] = float(s)
    texture.read(texture.texels.detach())
    u, view = torch.rand(2, 2, dtype=F64), directions(2)
    found = model.stage1(u, 0.5 * 2.0 ** -torch.tensor([2.5, 3.0], dtype=F64), view)
    expected = torch.tensor([[2.5, 3.0], [1.5, 2.0], [0.5, 1.0], [0.0, 0.0]], dtype=F64)
    for k, levels in enumerate(expected):
        torch.testing.assert_close(found[f"features_{k}"], levels[:, None].expand(2, 4))
