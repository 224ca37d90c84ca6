"""Errors of images and of test queries are noise-free; times are scaled to all pixels; offsets are traced."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import parallax, write_data

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import from_angles
from mbtf_fit.config import build_model
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.tile.heights import HeightGrid
from mbtf_pipeline.compare import timing
from mbtf_pipeline.compare.metrics import dataset_errors, image_errors
from mbtf_pipeline.compare.offsets import towards_view, traced_offset
from mbtf_pipeline.compare.timing import LIGHTS, measure_timing
from mbtf_pipeline.recipe import SceneView


def test_noise_of_the_reference_hardly_biases_the_relative_error() -> None:
    """Only the denominator includes it; the square of one half's difference would be twice as large."""
    truth, random = np.ones((96, 96, 3)), np.random.default_rng(7)
    a, b = (truth + 0.03 * random.standard_normal(truth.shape) for _ in range(2))
    found = image_errors(truth + 0.03, a, b, 1.0)["relative_mse"]
    assert found.value == pytest.approx(0.03**2 / 1.01, rel=0.15)
    assert found.error < 0.03 * found.value


def test_psnr_of_a_known_error() -> None:
    truth = np.full((16, 16, 3), 0.4)
    assert image_errors(truth + 0.02, truth, truth, 2.0)["psnr"].value == pytest.approx(40.0)
    record = image_errors(truth, truth, truth, 1.0)["psnr"].as_dict()
    assert record == {"value": None, "error": None, "n": 256}


def test_relative_error_does_not_depend_on_the_unit() -> None:
    truth = np.random.default_rng(3).random((32, 32, 3)) ** 4
    picture = 1.1 * truth
    found = [image_errors(s * picture, s * truth, s * truth, 1.0) for s in (1.0, 1e-6, 1e5)]
    values = [errors["relative_mse"].value for errors in found]
    assert values == pytest.approx([values[0]] * 3)
    assert 0 < values[0] < 0.01


def test_a_black_reference_has_no_relative_error() -> None:
    black = np.zeros((4, 4, 3))
    errors = image_errors(black + 1.0, black, black, 1.0)
    assert errors["mse"].value == 1.0
    assert math.isnan(errors["relative_mse"].value)


class Shifted:
    """A material with a constant error."""

    def __init__(self, model: str, shift: float) -> None:
        self.shift = shift
        self.model = build_model(model, Lattice(3))
        self.config = SimpleNamespace(model=model)
        sizes = {"network_weights": sum(p.numel() for p in self.model.parameter_groups()[1]), "texels": 5}
        errors = {"test": {"mse": "of other data"}, "held_out_queries": {"mse": "own"}}
        self.description = {"weights": sizes, "training": {"errors": errors, "seconds": 3.0, "steps": 9}}

    def predict(self, q: Any) -> np.ndarray:
        return (parallax(q.u, q.sigma, q.omega_i, q.omega_o) + self.shift).astype(np.float32)


def test_all_fits_are_evaluated_on_the_same_test_queries(tmp_path: Path) -> None:
    data = Dataset.open(write_data(tmp_path / "shards", parallax, train=64, noise=0.02))
    fits: Any = {"a": Shifted("neumip", 0.1), "b": Shifted("hierarchical", 0.05)}
    found = dataset_errors(fits, data)
    for name, square in (("a", 0.01), ("b", 0.0025)):
        mse = found[name]["splits"]["test"]["mse"]
        assert abs(mse["value"] - square) < 4 * mse["error"]
        assert found[name]["splits"]["held_out_queries"] == {"mse": "own"}
    less = found["b"]["mse_minus_first"]
    assert abs(less["value"] - (0.0025 - 0.01)) < 4 * less["error"]
    # Shared noise cancels in the paired difference.
    assert less["error"] < found["a"]["splits"]["test"]["mse"]["error"]
    assert set(less["levels"]) == {"0", "1", "2", "3"}
    assert all(e["value"] + 4 * e["error"] < 0 for e in less["levels"].values())
    assert "mse_minus_first" not in found["a"]


@pytest.mark.parametrize("model", ["neumip-baseline", "neumip", "hierarchical"])
def test_times_scale_to_all_pixels(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If every stage takes a second, only the scale remains."""

    def one_second(work: Any) -> tuple[Any, float]:
        return work(), 1.0

    monkeypatch.setattr(timing, "timed", one_second)
    network = build_model(model, Lattice(2))
    network.initialize(torch.Generator().manual_seed(0), 1.0)
    material: Any = SimpleNamespace(model=network, evaluate=lambda *arrays: arrays)
    pixels = 8 * 81 * 20
    found = measure_timing(material, pixels, "cpu")
    count = 20 if model == "hierarchical" else 81 * 20
    assert found["queries"] == count
    assert found["stage1_ms"] == pytest.approx(1e3 * pixels / count)
    for n in LIGHTS:
        expected = found["stage1_ms"] + n * found["stage2_ms"]
        assert found["lights_ms"][str(n)] == pytest.approx(expected)


DEPTH = 0.05


@pytest.fixture(scope="module")
def plane_below() -> object:
    """A plane at depth 0.05 with one peak that touches the reference plane, twice as high as wide."""
    load_mitsuba()
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene

    heights = np.full((64, 32), -DEPTH)
    heights[60, 2] = 0.0
    grid = HeightGrid.from_map(heights, 1.0, 2.0)
    tile = build_scene(grid, {"type": "diffuse"})
    return Estimator(tile, None, Transport())


@pytest.mark.parametrize(("elevation", "azimuth"), [(30, 0), (30, 135), (60, -90), (90, 0), (20, 250)])
def test_a_plane_below_is_displaced(plane_below: object, elevation: float, azimuth: float) -> None:
    u = np.array([[0.5, 0.5], [0.7, 0.4], [0.3, 0.6]], np.float32)
    found = traced_offset(plane_below, u, from_angles(elevation, azimuth))  # type: ignore[arg-type]
    distance = DEPTH / np.tan(np.radians(elevation))
    expected = -distance * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))])
    np.testing.assert_allclose(found, np.broadcast_to(expected, (3, 2)), atol=2e-6)
    along = towards_view(found, SceneView(elevation=elevation, azimuth=azimuth))
    np.testing.assert_allclose(along, -distance, atol=2e-6)
