"""Fits from start to end, and the materials they leave."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from support.datasets import edit, flip
from support.fit_data import constant, parallax, write_data

import mbtf_fit.material.material
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import FitConfig, FitResult, Material, evaluate, fit
from mbtf_fit.data.loader import load_split, load_training
from mbtf_fit.data.queries import ShardQueries
from mbtf_fit.evaluation import split_errors
from mbtf_fit.material.material import conformance_queries, export
from mbtf_fit.models.registry import MODELS
from mbtf_fit.training.trainer import prepare_trainer


def config(steps: int = 30, **options: Any) -> FitConfig:
    training = {"steps": steps, "batch": 1000, "warmup": 5, **options.pop("training", {})}
    return FitConfig.model_validate({"model": "neumip", "training": training, **options})


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data"), parallax, train=8000, noise=0.01, aspect=0.5)


@pytest.fixture(scope="module")
def fitted(data: Path, tmp_path_factory: pytest.TempPathFactory) -> FitResult:
    return fit(config(), data, tmp_path_factory.mktemp("fit") / "material")


def test_a_fit_states_the_lowest_direction_of_its_data(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "d", constant(0.25))
    edit(folder / "manifest.json", lambda manifest: manifest.update(config={"queries": {"min_cos": 0.3}}))
    assert fit(config(), folder, tmp_path / "m").material.description["data"]["min_cos"] == 0.3


def test_the_first_parameters_follow_the_seed(data: Path) -> None:
    opened = Dataset.open(data)
    partition = load_training(opened, config().held_out, 0)
    first, again, other = (
        prepare_trainer(config(seed=seed), opened, partition, torch.device("cpu")).model.weights()
        for seed in (0, 0, 1)
    )
    assert all(torch.equal(first[name], again[name]) for name in first)
    for name in ("pyramid.3", "decoder.0.weight", "offset_network.0.weight"):
        assert not torch.equal(first[name], other[name]), name


def test_the_folder_states_what_it_holds(fitted: FitResult) -> None:
    description = json.loads((fitted.folder / "material.json").read_text())
    weights = load_file(fitted.folder / "weights.safetensors")
    assert {k: list(weights[k].shape) for k in description["weights"]["shapes"]} == description["weights"][
        "shapes"
    ]
    assert weights["pyramid.3"].shape == weights["offset_texture.0"].shape == (4, 8, 7)
    assert weights["conformance.rgb"].shape == (256, 3)
    assert description["training"]["steps"] == 30
    held_out = [fitted.errors[name]["n"] for name in ("held_out_queries", "held_out_directions")]
    assert description["training"]["queries"] == 8000 - sum(held_out)
    assert not (fitted.folder / "checkpoint.safetensors").exists()


@pytest.mark.parametrize("finest", [0, 4])
def test_conformance_queries_include_seams_and_end_levels(finest: int) -> None:
    """Seams of the tile, footprints at both ends and beyond, light and view from straight above."""
    lattice = Lattice(finest)
    queries = conformance_queries(lattice)
    assert (queries["u"] == 0).any(0).all()
    assert (queries["u"] > 0.998).any(0).all()
    level = -np.log2(2 * queries["sigma"])
    assert level.min() == -1
    assert level.max() == finest + 1
    assert {0, finest} <= set(level.tolist())
    for name in ("omega_i", "omega_o"):
        assert (queries[name][:, 2] == 1).any()
        assert queries[name][:, 2].min() < 0.3


def test_conformance_is_pytorchs(fitted: FitResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fault in fast evaluation shows as a deviation from what is stored."""
    true = mbtf_fit.material.material.predict

    def faulty(*arguments: Any) -> np.ndarray:
        return true(*arguments) + np.float32(0.25)

    monkeypatch.setattr(mbtf_fit.material.material, "predict", faulty)
    material, description = fitted.material, fitted.material.description
    facts = {name: description[name] for name in ("data", "training")}
    again = export(material.model, material.config, tmp_path, **facts)
    np.testing.assert_array_equal(again.conformance["rgb"], material.conformance["rgb"])
    assert again.deviation() == pytest.approx(0.25, rel=1e-3)


def test_damaged_materials_are_refused(fitted: FitResult, tmp_path: Path) -> None:
    """Fuzzed files are those of test_fuzz_fits.py."""
    with pytest.raises(InputError, match=r"no material\.json"):
        Material.load(tmp_path)
    for name in ("material.json", "weights.safetensors"):
        (tmp_path / name).write_bytes((fitted.folder / name).read_bytes())
    weights = tmp_path / "weights.safetensors"
    flip(weights, -1)
    with pytest.raises(InputError, match=r"is damaged, .*SHA-256 is not "):
        Material.load(tmp_path)
    weights.unlink()
    with pytest.raises(InputError, match=r"weights\.safetensors: no such file"):
        Material.load(tmp_path)
    edited = json.loads((tmp_path / "material.json").read_text()) | {"schema": 99}
    (tmp_path / "material.json").write_text(json.dumps(edited))
    with pytest.raises(InputError, match="schema version 99"):
        Material.load(tmp_path)


def test_errors_of_a_perfect_prediction_are_zero(data: Path) -> None:
    opened = Dataset.open(data)
    queries = load_split(opened, "test")
    truth = parallax(queries.u, queries.sigma, queries.omega_i, queries.omega_o).astype(np.float32)
    perfect = split_errors(lambda q: truth, queries, opened)
    flat = split_errors(lambda q: np.full_like(truth, truth.mean(0)), queries, opened)
    assert abs(perfect["mse"]["value"]) < 4 * perfect["mse"]["error"]
    assert flat["unexplained"]["value"] == pytest.approx(1.0, abs=0.02)
    # Of color likewise, although its noise is as large as its variance.
    assert abs(perfect["color"]["value"]) < 4 * perfect["color"]["error"]
    assert flat["color"]["value"] == pytest.approx(1.0, abs=0.05)
    differences = truth - np.roll(truth, 1, axis=1)
    assert flat["color"]["share"] == pytest.approx(differences.var(0).mean() / truth.var(0).mean(), rel=0.2)
    for groups in (flat["levels"], flat["elevations"]):
        assert sum(errors["n"] for errors in groups.values()) == len(queries)
    assert set(flat["elevations"]) == {"0-0.2", "0.2-0.4", "0.4-0.7", "0.7-1"}


def test_gray_data_have_no_error_of_color(data: Path) -> None:
    opened = Dataset.open(data)
    stored = load_split(opened, "test")
    gray = np.repeat(stored.value_a[:, :1], 3, axis=1)
    found = split_errors(lambda q: 1.1 * gray, replace(stored, value_a=gray, value_b=gray), opened)
    assert found["unexplained"]["value"] is not None
    assert found["color"]["value"] is None


def test_few_queries_that_decide_an_error_are_said(data: Path) -> None:
    """Ten errors of 1 among many of 0.1; each also counts as often as its weight says."""
    opened = Dataset.open(data)
    stored = load_split(opened, "test")
    truth, n = stored.value_a, len(stored)
    wrong = np.full_like(truth, 0.1)
    wrong[5:105:10] = 1.0
    for heavy in (None, 3.0):
        weight = None if heavy is None else np.where(wrong[:, 0] == 1, heavy, 1).astype(np.float32)
        queries = ShardQueries(**(vars(stored) | {"value_b": truth, "weight": weight}))
        found = split_errors(lambda q: truth + wrong, queries, opened)
        ten = 10 * (heavy or 1.0)
        assert found["ten_largest"] == pytest.approx(ten / (ten + 0.01 * (n - 10)), rel=1e-3)


def test_evaluation_refuses_a_tile_of_another_shape(fitted: FitResult, tmp_path: Path) -> None:
    other = write_data(tmp_path / "d", parallax, train=100, aspect=1.0)
    with pytest.raises(InputError, match=r"aspect 1, the material's 0\.5"):
        evaluate(fitted.material, other)


def test_another_configuration_is_refused_with_its_differences(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "m"
    fit(config(3), data, out)
    with pytest.raises(
        InputError, match=r"training\.batch: 1000 -> 500; training\.steps: 3 -> 4.*\n.*--overwrite"
    ):
        fit(config(4, training={"batch": 500}), data, out)
    other = write_data(tmp_path / "d", parallax, train=8000, aspect=0.5, seed=1)
    with pytest.raises(InputError, match=r"data\.hash: .* -> "):
        fit(config(3), other, out)
    assert fit(config(4), data, out, overwrite=True).history[-1]["step"] == 4


def test_a_changed_model_is_another_fit(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, before = tmp_path / "m", MODELS["neumip"].operations
    fit(config(3), data, out)
    assert fit(config(3), data, out).resumed
    doubled = [*before(Lattice(3, 0.5), config().network)]
    doubled[-1] = dataclasses.replace(doubled[-1], scale=2.0)  # type: ignore[call-arg]
    monkeypatch.setattr(MODELS["neumip"], "operations", lambda lattice, network: doubled)
    with pytest.raises(InputError, match="of another configuration: operations"):
        fit(config(3), data, out)


def test_evaluation_broadcasts_as_numpy_does(fitted: FitResult) -> None:
    """A picture of (rows, columns) points under one light and one view."""
    material = fitted.material
    u = np.random.default_rng(3).random((4, 1, 2))
    sigma, light, views = 0.05, [0.6, 0.0, 0.8], np.array([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [0.8, 0.0, 0.6]])
    picture, offsets = material.evaluate(u, sigma, light, views), material.offset(u, views)
    for i, j in ((0, 0), (3, 1), (1, 2)):
        np.testing.assert_allclose(
            picture[i, j], material.evaluate(u[i, 0], sigma, light, views[j]), atol=1e-6
        )
        np.testing.assert_allclose(offsets[i, j], material.offset(u[i, 0], views[j]), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("u", "here", "no array of real numbers"),
        ("u", [["0.1", "0.2"]], "no array of real numbers"),
        ("sigma", [[0.1], [0.1, 0.2]], "no array of real numbers"),
        ("u", [0.5, np.nan], r"NaN or infinity \(1 of 2"),
        ("sigma", np.nan, r"NaN or infinity \(1 of 1"),
        ("sigma", [0.1, -1.0], r"is negative \(1 of 2"),
        ("u", np.zeros((5, 1)), "have the shapes"),
        ("u", 0.5, "have the shapes"),
        ("u", np.zeros(3), "have the shapes"),
        ("omega_i", 1.0, "have the shapes"),
        ("omega_i", [0.0, 0.0, 5.0], "1 of 1 directions"),
        ("omega_o", [0.6, 0.0, -0.8], "1 of 1 directions are not above the plane; the first, at index 0"),
        ("omega_o", [0.0, 1.0], "have the shapes"),
        ("omega_o", [0.0, 0.0, np.nan], "NaN or infinity"),
    ],
)
def test_odd_inputs_are_refused_by_name(fitted: FitResult, name: str, value: Any, what: str) -> None:
    given = {"u": [0.5, 0.5], "sigma": 0.1, "omega_i": [0, 0, 1], "omega_o": [0, 0, 1], name: value}
    with pytest.raises(InputError, match=what) as fault:
        fitted.material.evaluate(**given)
    assert name in str(fault.value.where)
