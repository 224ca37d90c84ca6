"""What a material lets through: found from data, written, read back, refused when damaged."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from support.fit_data import constant, random_queries, write_data, write_images
from support.known_surfaces import geometry

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.data.shard_files import read_shard, write_shard
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import file_sha256
from mbtf_fit.cli.results import report_errors
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.data.streaming import Selection
from mbtf_fit.evaluation import evaluate
from mbtf_fit.material.format import read_description
from mbtf_fit.material.transmittance import (
    TRANSMITTANCE_NAME,
    Transmittance,
    evaluate_transmittance,
    fit_transmittance,
    read_transmittance,
    write_transmittance,
)
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.fit import fit


def lace(u: np.ndarray, sigma: np.ndarray, omega_o: np.ndarray) -> np.ndarray:
    """Holes towards one side of the tile that close at grazing views, on one side more than on the other."""
    fade = np.exp(-2 * (np.pi * sigma) ** 2)
    wave = fade * np.sin(2 * np.pi * u[:, 0]) + 0.5 * fade * np.cos(2 * np.pi * u[:, 1])
    x, y = omega_o[:, 0], omega_o[:, 1]
    return np.asarray((0.45 + 0.2 * wave) * (1 - 0.7 * (x * x + y * y)) + 0.1 * x - 0.05 * y)


def chosen(data: Dataset, held_out: HeldOutSection | None = None) -> Selection:
    """What is trained on; everything by default."""
    return load_training(data, held_out or HeldOutSection(queries=0, radius=0), 0).selection


def test_a_known_transmittance_is_found(tmp_path: Path) -> None:
    data = Dataset.open(
        write_data(tmp_path, constant(0.2), train=120_000, finest=4, aspect=0.5, through=lace)
    )
    model = fit_transmittance(data, chosen(data))
    assert model is not None
    q = random_queries(np.random.default_rng(9), 4000, data.lattice)
    found = model.evaluate(q["u"] + np.float32(2.0), q["sigma"], q["omega_o"])
    wanted = lace(q["u"], q["sigma"], q["omega_o"])
    assert wanted.std() > 0.1
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.035
    fine = q["sigma"] < 0.045
    assert np.sqrt(np.mean((found - wanted)[fine] ** 2)) < 0.02


def test_holes_are_found_at_their_depths(tmp_path: Path) -> None:
    """Two sheets with holes at depths between those of the layers, seen through one another."""
    lattice, aspect = Lattice(4, 0.5), 0.5
    heights = np.zeros((8, 8), np.float32)
    heights[2:] = -0.2
    surface = geometry(lattice, heights)

    def sheets(u: np.ndarray, sigma: np.ndarray, omega_o: np.ndarray) -> np.ndarray:
        fade, total = np.exp(-2 * (np.pi * sigma) ** 2), np.zeros(len(u))
        for depth, turn in ((0.07, 0.0), (0.13, 1.0)):
            at = u - depth / omega_o[:, 2:] * omega_o[:, :2] / (1.0, aspect)
            total += 0.2 + 0.2 * fade * np.sin(2 * np.pi * at[:, 0] + turn)
        return total

    data = Dataset.open(
        write_data(
            tmp_path, constant(0.2), train=120_000, finest=4, aspect=aspect, through=sheets, geometry=surface
        )
    )
    model = fit_transmittance(data, chosen(data))
    assert model is not None
    assert model.depths == pytest.approx((-0.1, -0.05, -0.15))
    q = random_queries(np.random.default_rng(9), 4000, lattice)
    steep = q["omega_o"][:, 2] > 0.3
    found, wanted = (f(q["u"], q["sigma"], q["omega_o"])[steep] for f in (model.evaluate, sheets))
    assert wanted.std() > 0.1
    # A layer at the reference plane alone leaves 0.09.
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.04


def test_few_queries_fall_back_on_coarser_levels(tmp_path: Path) -> None:
    """No texel of an empty neighborhood is left without a value."""
    data = Dataset.open(
        write_data(tmp_path, constant(0.2), train=200, finest=6, through=lambda u, s, o: 0.6 + 0 * s)
    )
    model = fit_transmittance(data, chosen(data))
    assert model is not None
    q = random_queries(np.random.default_rng(9), 500, data.lattice)
    assert np.abs(model.evaluate(q["u"], q["sigma"], q["omega_o"]) - 0.6).max() < 0.1


def test_a_fit_writes_it_beside_the_weights_and_only_for_holes(tmp_path: Path) -> None:
    config = FitConfig.model_validate({"training": {"steps": 2, "batch": 256}})
    write_data(tmp_path / "solid", constant(0.2), train=600, test=64)
    write_data(tmp_path / "lace", constant(0.2), train=600, test=64, through=lace)
    fit(config, tmp_path / "solid", tmp_path / "a")
    assert not (tmp_path / "a" / TRANSMITTANCE_NAME).exists()
    assert read_transmittance(tmp_path / "a", read_description(tmp_path / "a")[0]) is None
    fit(config, tmp_path / "lace", tmp_path / "b")
    description, _ = read_description(tmp_path / "b")
    read = read_transmittance(tmp_path / "b", description)
    data = Dataset.open(tmp_path / "lace")
    fitted = fit_transmittance(data, chosen(data, config.held_out))
    assert read is not None
    assert fitted is not None
    for mine, theirs in zip(read.layers[0], fitted.layers[0], strict=True):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_held_out_queries_are_evaluated_and_not_fitted(layout: str, tmp_path: Path) -> None:
    """Changed held-out rows leave the fit as it is and increase its held-out error."""
    held_out = HeldOutSection(queries=0.2, radius=0.15)
    if layout == "image":
        write_images(tmp_path, constant(0.2), train=400, through=lace)
    else:
        write_data(tmp_path, constant(0.2), train=40_000, finest=3, through=lace)
    data = Dataset.open(tmp_path)
    selection = chosen(data, held_out)
    before = fit_transmittance(data, selection)
    assert before is not None
    honest = evaluate_transmittance(before, data, selection)
    for shard, mask in selection.masks():
        path = shard.local()
        arrays = dict(read_shard(path, mapped=False))
        assert 0.1 < (~mask).mean() < 0.6
        through = arrays["transmittance"].copy()
        through[~mask] += 0.5
        write_shard(path, {**arrays, "transmittance": through})
    after = fit_transmittance(data, selection)
    assert after is not None
    for mine, theirs in zip(before.layers[0], after.layers[0], strict=True):
        np.testing.assert_array_equal(mine, theirs)
    evaluated = evaluate_transmittance(after, data, selection)
    assert evaluated["held_out"]["mse"]["value"] == pytest.approx(0.25, rel=0.1)
    for name in ("training", "test"):
        assert evaluated[name]["mse"] == honest[name]["mse"]
        assert honest[name]["mse"]["value"] < 2e-3
    assert honest["held_out"]["mse"]["value"] < 2e-3


def test_errors_include_the_noise_and_its_bound(tmp_path: Path) -> None:
    """Holes are hit or missed: of four independent paths each, a quarter of p(1-p) is noise."""
    random = np.random.default_rng(3)

    def through(u: np.ndarray, sigma: np.ndarray, omega_o: np.ndarray) -> np.ndarray:
        return random.binomial(4, 0.3, len(sigma)) / 4

    folder = write_data(tmp_path, constant(0.2), train=30_000, test=20_000, finest=1, through=through)
    for path in folder.glob("*.npz"):
        arrays = dict(read_shard(path, mapped=False))
        write_shard(path, {**arrays, "spp": np.full(len(arrays["spp"]), 4, np.float32)})
    material = tmp_path / "material"
    result = fit(FitConfig.model_validate({"training": {"steps": 2, "batch": 256}}), folder, material)
    stated = result.as_dict()["training"]["transmittance"]
    found = evaluate(result.material, folder)["transmittance"]
    assert stated == found
    assert list(found) == ["test", "held_out", "training"]
    (line,) = (line for line in report_errors(result.errors, found, False) if "transmittance" in line)
    least, most = map(float, re.findall(r"between ([\d.]+) and ([\d.]+)", line)[0])
    # All of the error is noise.
    assert least < 0.06
    assert most == pytest.approx(found["test"]["mse"]["value"] ** 0.5, abs=1e-3)
    for error in found.values():
        noise = error["noise"]["value"]
        assert noise == pytest.approx(0.3 * 0.7 / 4, rel=0.08)
        # Some hundreds are held out.
        few = 0.2 if error["n"] < 5000 else 0.05
        assert error["mse"]["value"] == pytest.approx(noise, rel=few)
        assert error["variance"] == pytest.approx(noise, rel=few)


def test_views_from_below_and_along_the_normal() -> None:
    """Layers are read where a line crosses them, from either end; grazing ones at a cosine of 0.05."""
    random, lattice = np.random.default_rng(4), Lattice(1, 2.0)
    layers = [
        [random.normal(0.2, 0.1, (*lattice.shape(s), 6)).astype(np.float32) for s in (0, 1)] for _ in "ab"
    ]
    model = Transmittance(lattice, (-0.1, -0.3), layers)
    u, sigma = random.random((50, 2)), np.full(50, 0.25)
    omega = random.normal(size=(50, 3))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    np.testing.assert_array_equal(model.evaluate(u, sigma, omega), model.evaluate(u, sigma, -omega))
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    rows, columns = lattice.shape(1)
    texel = np.array([(i, j) for j in range(rows) for i in range(columns)])
    center = (texel + 0.5) / (columns, rows) * (1, -1) + (0, 1)
    found = model.evaluate(center, sigma[: len(center)], up[: len(center)]).reshape(rows, columns)
    np.testing.assert_allclose(model.from_above(1), found, rtol=1e-6)
    grazing, steep = np.array([[0.9998, 0.0, 0.02], [0.9998, 0.0, 0.05]])
    both = [model.evaluate(u[:1], sigma[:1], omega[None])[0] for omega in (grazing, steep)]
    assert both[0] == pytest.approx(both[1], rel=1e-6)


def test_damaged_layers_are_refused(tmp_path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    lattice = Lattice(1)
    layers = [[np.full((*lattice.shape(s), 6), k + s, np.float32) for s in (0, 1)] for k in range(3)]
    path, description = tmp_path / TRANSMITTANCE_NAME, {"levels": {"finest": 1}, "tile": {"aspect": 1.0}}
    write_transmittance(Transmittance(lattice, (-0.1, -0.2, -0.3), layers), path)
    tensors = load_file(path)

    def read(changed: dict[str, np.ndarray]) -> Transmittance | None:
        save_file({**tensors, **changed}, path)
        stated = {"file": path.name, "sha256": file_sha256(path)}
        return read_transmittance(tmp_path, {**description, "transmittance": stated})

    again = read({})
    assert again is not None
    assert [[a[0, 0, 0] for a in levels] for levels in again.layers] == [[0, 1], [1, 2], [2, 3]]
    for changed in (
        {"depths": np.array(0.0, np.float32)},
        {"depths": np.zeros(0, np.float32)},
        {"depths": np.array([np.nan] * 3, np.float32)},
        {"depths": np.array([0.1, 0.0, 0.0], np.float32)},
        {"depths": np.zeros(3, np.int64)},
        {"depths": np.zeros(4, np.float32)},
        {"1.1": np.zeros((2, 2, 6), np.complex64)},
        {"2.0": np.zeros((1, 1, 5), np.float32)},
    ):
        with pytest.raises(InputError, match=TRANSMITTANCE_NAME):
            read(changed)


def test_values_are_those_of_the_polynomial() -> None:
    """Nothing but the polynomial of the view's projection, at a texel's center, clamped."""
    lattice = Lattice(0)
    texel = np.array([0.5, 0.2, -0.1, -0.3, 0.4, 0.1], np.float32).reshape(1, 1, 6)
    model = Transmittance(lattice, (0.0,), [[texel]])
    omega = np.array([[0.6, -0.3, 0.74], [0.0, 0.0, 1.0]])
    x, y = omega[0, :2]
    wanted = 0.5 + 0.2 * x - 0.1 * y - 0.3 * x * x + 0.4 * x * y + 0.1 * y * y
    np.testing.assert_allclose(model.evaluate([[0.1, 0.9]] * 2, [0.3] * 2, omega), [wanted, 0.5], rtol=1e-6)
    assert Transmittance(lattice, (0.0,), [[8 * texel]]).evaluate([[0.1, 0.9]], [0.3], omega[1:])[0] == 1.0
