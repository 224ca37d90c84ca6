"""A material beyond its data: any footprint, direction and position; half precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support.fit_data import make_trainer, parallax, random_queries, train_fully, training_queries
from support.surfaces import towards

from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.material.material import Material, export
from mbtf_fit.ops.constants import GRAZING

LATTICE = Lattice(3)
N = 400


def queries(seed: int = 1) -> dict[str, np.ndarray]:
    return random_queries(np.random.default_rng(seed), N, LATTICE)


@pytest.fixture(scope="module", params=["neumip-baseline", "neumip"])
def material(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Material:
    """Fitted to a wave that darkens towards grazing light, until its weights are no longer random."""
    arrays = random_queries(np.random.default_rng(0), 4000, LATTICE)
    data = training_queries(arrays, parallax(*arrays.values()))
    options = {"steps": 120, "batch": 500, "warmup": 20, "blur": {"initial_sigma": 2.0, "offset_sigma": 1.0}}
    trainer = train_fully(make_trainer(data, LATTICE, request.param, **options))
    nothing = np.zeros((N, 3), np.float32)
    # Lookups read the blurred textures from then on.
    trainer.predict(ShardQueries(*queries().values(), nothing, nothing))
    folder = tmp_path_factory.mktemp("material")
    config = FitConfig.model_validate({"model": request.param})
    training = {"steps": 120, "batch": 500, "seconds": 0.0, "device": "cpu", "threads": 1, "errors": {}}
    return export(trainer.model, config, folder, data={}, training=training)


def evaluate(material: Material, **changed: object) -> np.ndarray:
    """Values at the queries with some arrays replaced; always finite and nonnegative."""
    arrays = {**queries(), **changed}
    found = material.evaluate(**{k: np.broadcast_to(v, queries()[k].shape) for k, v in arrays.items()})
    assert np.isfinite(found).all()
    assert (found >= 0).all()
    return found


@pytest.mark.parametrize(
    ("sigmas", "level"),
    [((0.0, 1e-38, 1e-12, 0.5 * 2.0**-3 * 0.999), 3), ((0.5001, 1.0, 1e3, 1e30, np.inf), 0)],
)
def test_footprints_are_clamped_to_the_levels(
    material: Material, sigmas: tuple[float, ...], level: int
) -> None:
    """Bit for bit the value at σ_k = 2^-k / 2, for k = 0 and the finest level."""
    expected = evaluate(material, sigma=np.float32(0.5 * 2.0**-level))
    for sigma in sigmas:
        assert np.array_equal(evaluate(material, sigma=np.float32(sigma)), expected)


def test_footprints_at_the_ends_and_between_levels_are_continuous(material: Material) -> None:
    """Changing a footprint by a millionth changes values by less than 1e-4 of the largest one, at the clamped
    ends and where the interpolated levels change."""
    for level in range(4):
        sigma = 0.5 * 2.0**-level
        low, high = (evaluate(material, sigma=np.float32(sigma * f)) for f in (1 - 1e-6, 1 + 1e-6))
        assert np.abs(low - high).max() < 1e-4 * high.max()


@pytest.mark.parametrize("role", ["omega_i", "omega_o"])
def test_directions_below_the_data_are_continued_smoothly(material: Material, role: str) -> None:
    """From the data's edge (cosine 0.1) to 1e-7 on the projected disk is half a per cent of its radius:
    values stay below twice the largest within the data, and steps of 1e-5 in the cosine change them by less
    than 1e-3 of it, at the edge and at the horizon."""
    azimuth = np.linspace(0, 360, N, endpoint=False)
    inside = max(evaluate(material, **{role: towards(np.full(N, c), azimuth)}).max() for c in (0.1, 0.5, 1.0))
    for cosine in (0.1, 0.05, 1e-2, 1e-3, 1e-4, 1e-7):
        found = evaluate(material, **{role: towards(np.full(N, cosine), azimuth)})
        assert found.max() < 2 * inside
        near = evaluate(material, **{role: towards(np.full(N, cosine + 1e-5), azimuth)})
        assert np.abs(near - found).max() < 1e-3 * inside


def test_offsets_at_grazing_views_are_bounded() -> None:
    """``r / max(ω_o,z, 0.6) · ω_o,xy`` whatever r the network answers, so never longer than |r|/0.6; features
    at u' and their gradients are finite."""
    model = build_model("neumip", LATTICE)
    generator = torch.Generator().manual_seed(3)
    model.initialize(generator, 0.1)
    cosine = np.concatenate([10.0 ** np.linspace(-4, 0, N // 2), np.linspace(0, 1, N // 2)])
    omega_o = torch.from_numpy(towards(cosine, np.linspace(0, 3600, N)).astype(np.float32))
    u = torch.rand(N, 2, generator=generator)
    for scale in (0.1, 1e3):
        with torch.no_grad():
            model.offset_texture.texels.normal_(0, scale, generator=generator)
            seen = torch.cat([model.offset_texture(u), omega_o[:, :2]], 1)
            r = 0.1 * model.offset_network(seen)[:, 0]
            length = model.offset(u, omega_o).norm(dim=1)
        sine = omega_o[:, :2].norm(dim=1)
        assert bool((length <= r.abs() / GRAZING * 1.00001).all())
        torch.testing.assert_close(length, r.abs() * sine / omega_o[:, 2].clamp_min(GRAZING))
        features = model.stage1(u, torch.full((N,), 0.1), omega_o)["features"]
        assert bool(features.isfinite().all())
        parameters = list(model.parameters())
        gradients = torch.autograd.grad(features.sum(), parameters, allow_unused=True)
        assert all(g is None or bool(g.isfinite().all()) for g in gradients)


def test_positions_far_away_repeat_the_tile(material: Material) -> None:
    """u and u + 1000 tiles are the same position up to rounding, 6e-5 tiles; slopes are below the largest
    value per quarter texel."""
    here = evaluate(material)
    for shift in (-1000.0, -1.0, 1.0, 1000.0):
        there = evaluate(material, u=queries()["u"] + np.float32(shift))
        assert np.abs(there - here).max() < 2e-3 * here.max()


def test_half_precision_is_accurate_for_values_of_any_size(material: Material, tmp_path: Path) -> None:
    """Half precision ends at 65504, but weights are of order one for data of any scale. With all tensors
    of more than one number in half precision, values change by less than 1% of the largest one."""
    weights = material.model.weights()
    large = {name: tensor.clone() for name, tensor in weights.items()}
    large["unit"] = large["unit"] * 1e6
    halved = {
        name: tensor.clone() if tensor.ndim == 0 else tensor.half().float() for name, tensor in large.items()
    }
    assert all(bool(t.isfinite().all()) for t in halved.values())
    found = []
    for tensors in (large, halved):
        model = build_model(material.config.model, LATTICE)
        model.load_weights(tensors)
        with torch.no_grad():
            found.append(model(*(torch.from_numpy(a) for a in queries().values())))
    assert found[0].max() > 1e5
    assert (found[1] - found[0]).abs().max() < 0.01 * found[0].max()
