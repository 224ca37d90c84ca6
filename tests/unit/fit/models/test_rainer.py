"""The models of Rainer et al.: sizes, normalization, levels, what the shared network learns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.slice_data import prepared as prepared_model
from support.slice_data import spots, write_slices

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_fit import fit
from mbtf_fit.config import FitConfig, build_model
from mbtf_fit.data.layouts import TrainingSlices
from mbtf_fit.data.loader import load_training
from mbtf_fit.data.queries import mean_value
from mbtf_fit.material.material import Material
from mbtf_fit.models.model import Preparation
from mbtf_fit.models.rainer import Rainer2019, shared_slices
from mbtf_fit.objective.noise import typical_value
from mbtf_fit.training.fit_folder import identity_of
from mbtf_gen.sampling.query_sampler import direction_pairs, slice_directions

NAMES = ("rainer2019", "rainer2020")


def config(name: str, **training: Any) -> FitConfig:
    options = {"steps": 250, "batch": 1024, "warmup": 20, **training}
    return FitConfig.model_validate({"model": name, "training": options})


def prepared(name: str, finest: int = 2, lights: int = 6) -> tuple[Rainer2019, TrainingSlices]:
    """An initialized model, and random slices."""
    material = build_model(name, Lattice(finest))
    generator = torch.Generator().manual_seed(0)
    material.initialize(generator, 0.1)
    model = prepared_model(material, name, lights**2, torch.device("cpu"))
    light, view = map(torch.from_numpy, direction_pairs(slice_directions("spiral", lights, 0.2)))
    values = 0.2 * torch.rand(4**finest, lights**2, 3, generator=generator)
    return model, TrainingSlices(values, light, view, 0.5 * 2.0**-finest)


@pytest.mark.parametrize(
    ("name", "weights", "channels"), [("rainer2019", 35725, 14), ("rainer2020", 38269, 38)]
)
def test_sizes_are_the_published_ones(name: str, weights: int, channels: int) -> None:
    """Kuznetsov et al. 2021 count them."""
    model, _ = prepared(name)
    assert sum(p.numel() for p in model.material.parameter_groups()[1]) == weights
    assert model.material.pyramid.texels.shape[1] == channels
    assert sum(p.numel() for p in model.trained()[1]) > weights


@pytest.mark.parametrize("name", NAMES)
def test_the_normalization_is_undone(name: str) -> None:
    """A decoder that returned the normalized logarithms would reproduce the slices."""
    model, slices = prepared(name)
    normalized, statistics = model.normalized(slices.values, slices.omega_i)
    assert normalized.mean(1).abs().max() < 1e-5
    features = torch.cat([torch.zeros(16, model.latents), statistics], 1)
    for pair in (0, 7, 35):
        x = normalized[:, pair]
        model.material.decoder.forward = lambda _, x=x: x  # type: ignore[method-assign, misc]
        light, view = (omega[pair].expand(16, 3) for omega in (slices.omega_i, slices.omega_o))
        value = model.material.stage2({"texture": features}, light, view)
        torch.testing.assert_close(value, slices.values[:, pair], rtol=1e-4, atol=1e-6)


def test_constant_and_black_slices_need_no_decoder() -> None:
    model, slices = prepared("rainer2019")
    for value in (0.0, 0.3):
        same = TrainingSlices(
            value / slices.omega_i[None, :, 2:].expand_as(slices.values), slices.omega_i, slices.omega_o, 0.1
        )
        model.write_textures(same)
        u, sigma = torch.rand(50, 2), torch.full((50,), 0.125)
        light = slices.omega_i[:36].repeat(2, 1)[:50]
        found = model.material(u, sigma, light, light)
        torch.testing.assert_close(found * light[:, 2:], torch.full((50, 3), value), atol=0.01, rtol=0.02)


@pytest.mark.parametrize("name", NAMES)
def test_coarser_levels_are_averages(name: str) -> None:
    model, slices = prepared(name)
    model.write_textures(slices)
    levels = model.material.pyramid.export()
    torch.testing.assert_close(levels["0"][0, 0], levels["2"].mean((0, 1)), rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(levels["1"][1, 0], levels["2"][2:, :2].mean((0, 1)), rtol=1e-4, atol=1e-6)
    encoded = model.encode(slices.values[9:10], slices.omega_i, slices.omega_o)
    torch.testing.assert_close(levels["2"][2, 1], encoded[0].detach(), rtol=1e-4, atol=1e-6)


def test_the_encoder_of_2020_takes_any_set_of_samples() -> None:
    model, slices = prepared("rainer2020")
    order = torch.randperm(36)
    whole = model.encode(slices.values, slices.omega_i, slices.omega_o)
    mixed = model.encode(slices.values[:, order], slices.omega_i[order], slices.omega_o[order])
    torch.testing.assert_close(mixed, whole, rtol=1e-3, atol=1e-5)
    half = model.encode(slices.values[:, ::2], slices.omega_i[::2], slices.omega_o[::2])
    assert half.shape == whole.shape
    # Directions matter, not only the values.
    swapped = model.encode(slices.values, slices.omega_o, slices.omega_o)
    assert (swapped - whole).abs().max() > 0.01


@pytest.mark.parametrize("name", NAMES)
def test_a_smooth_material_is_learned_and_loads_again(name: str, tmp_path: Path) -> None:
    shards = write_slices(tmp_path / "data", noise=0.002, finest=3, lights=12)
    result = fit(config(name), shards, tmp_path / "fit")
    # Queries between the texels and the directions of the slices, at every level.
    assert result.errors["test"]["unexplained"]["value"] < 0.15
    assert "held_out_queries" in result.errors
    material = Material.load(tmp_path / "fit")
    assert material.deviation() == 0.0
    assert not any("encoder" in key for key in material.description["weights"]["shapes"])


def test_a_model_of_queries_is_trained_on_slices(tmp_path: Path) -> None:
    """It is evaluated between the texels and directions, and at levels that no slice has."""
    shards = write_slices(tmp_path / "data", noise=0.002, finest=3, lights=12)
    result = fit(config("neumip-baseline"), shards, tmp_path / "fit")
    assert result.errors["test"]["unexplained"]["value"] < 0.15


def dark(u: Any, sigma: Any, omega_i: Any, omega_o: Any) -> Any:
    """Another material, a tenth as bright."""
    return 0.1 * spots(1.0 - u, sigma, omega_i, omega_o)


def test_a_network_of_other_materials_encodes_a_new_one(tmp_path: Path) -> None:
    own, other = (
        write_slices(tmp_path / name, function, finest=3, lights=lights)
        for name, function, lights in (("own", dark, 12), ("other", spots, 10))
    )
    shared = {"materials": [str(other)], "own_material": False}
    result = fit(config("rainer2020", **shared), own, tmp_path / "fit")
    assert result.errors["test"]["unexplained"]["value"] < 0.3


def test_the_network_learns_others_in_units_of_its_own_material(tmp_path: Path) -> None:
    """Ten times as bright as `dark`, before they are scaled to the typical value 0.02."""
    held_out = config("rainer2020").held_out
    own, other = (
        load_training(Dataset.open(write_slices(tmp_path / name, function)), held_out, 0)
        for name, function in (("own", dark), ("other", spots))
    )
    typical = typical_value(mean_value(other.sample.value_a, other.sample.value_b))
    training = config("rainer2020", materials=["other"]).training
    data = Dataset.open(tmp_path / "own")
    given = Preparation(data, own.training, training, 0.02, 0, lambda _: (other.training, typical))
    first, second = shared_slices(given).learned
    assert first is own.training
    assert 0.5 < second.values.mean() / first.values.mean() < 2.0


def test_a_fit_is_known_by_what_other_data_hold(tmp_path: Path) -> None:
    """Moved data are the same; any other set of them changes the fit."""

    def hash_of(*others: Path) -> str:
        options = config("rainer2020", materials=[str(other) for other in others])
        return str(identity_of(options, own)["config_hash"])

    own = Dataset.open(write_slices(tmp_path / "own"))
    first, second = (write_slices(tmp_path / name, lights=n) for name, n in (("a", 12), ("b", 13)))
    both, one, order = hash_of(first, second), hash_of(first), hash_of(second, first)
    moved = first.rename(tmp_path / "elsewhere")
    assert hash_of(moved, second) == both
    assert len({both, one, order, hash_of(second), hash_of()}) == 5


def test_slices_of_cloth_have_a_transmittance(tmp_path: Path) -> None:
    """The transmittance is fitted to all texels, with the finest footprint."""
    shards = write_slices(tmp_path / "data", through=lambda u, s, o: np.where(u[:, 0] < 0.5, 0.8, 0.2))
    material = fit(config("rainer2019", steps=3), shards, tmp_path / "fit").material
    assert material.transmittance is not None
    u = np.array([[0.25, 0.5], [0.75, 0.5]])
    omega = slice_directions("spiral", 2, 0.5)
    found = material.transmittance.evaluate(u, np.full(2, 1 / 16), omega)
    np.testing.assert_allclose(found, (0.8, 0.2), atol=0.1)
