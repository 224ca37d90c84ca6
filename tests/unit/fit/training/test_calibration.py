"""Factors that set the mean reflectance at each elevation to that of the data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from support.fit_data import random_queries, training_queries, write_data

from mbtf_core.data.lattice import Lattice, level_of_sigma
from mbtf_fit import FitConfig, fit
from mbtf_fit.data.loader import in_region
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.material.inference import predict
from mbtf_fit.ops.constants import KNOTS
from mbtf_fit.pytorch.operations import interpolate_factors
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.calibration import POINTS, fit_calibration

F32 = np.ndarray
LATTICE = Lattice(3)
TINT = np.array([0.3, 0.2, 0.1])
# Wide, so that it shows in means.
HELD_OUT = HeldOutSection(radius=0.4)


def truth(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> F32:
    """A pattern under light and view of their own, with equal means at all levels."""
    fade = np.exp(-2 * (np.pi * np.asarray(sigma, np.float64)) ** 2)
    shade = (1 + 0.8 * fade * np.sin(2 * np.pi * u[:, 0])) * (1 + omega_i[:, 2] * omega_o[:, 0] ** 2)
    return np.asarray(shade[:, None] * TINT, np.float32)


def wrong(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> F32:
    """The same with errors of level and elevations."""
    level = np.clip(level_of_sigma(np.asarray(sigma, np.float64)), 0, 3)
    off = 1 + 0.1 * np.sin(6 * omega_i[:, 2]) * (1 - 0.2 * level) + 0.08 * omega_o[:, 2] ** 2
    return np.asarray(truth(u, sigma, omega_i, omega_o) * off[:, None] * [1.0, 1.05, 0.9], np.float32)


def data(n: int, noise: float, seed: int = 0) -> TrainingQueries:
    """Queries with skewed noise, that of paths; none in the held-out region."""
    random = np.random.default_rng(seed)
    queries = random_queries(random, n, LATTICE)
    seen = ~(in_region(HELD_OUT, queries["omega_i"]) | in_region(HELD_OUT, queries["omega_o"]))
    queries = {name: array[seen] for name, array in queries.items()}
    value = truth(*queries.values())
    return training_queries(queries, value * (1 + noise * (random.exponential(1.0, value.shape) - 1)))


def excess(calibration: F32 | None, sigma: float, axis: int) -> F32:
    """(wrong · calibration) over truth, minus 1, by six bands of light's (0) or view's (1) elevation."""
    random = np.random.default_rng(7)
    q = random_queries(random, 60_000, LATTICE)
    q["sigma"] = np.full_like(q["sigma"], sigma)
    value = wrong(*q.values()).astype(np.float64)
    if calibration is not None:
        level = torch.from_numpy(np.clip(level_of_sigma(q["sigma"]), 0, 3).astype(np.float32))
        for table, omega in zip(torch.from_numpy(calibration), (q["omega_i"], q["omega_o"]), strict=True):
            value *= interpolate_factors(table, level, torch.from_numpy(omega[:, 2])).numpy()
    cosine = q["omega_i" if axis == 0 else "omega_o"][:, 2]
    band = np.minimum(((cosine - 0.1) / 0.15).astype(int), 5)
    means = [np.stack([v[band == k].mean(0) for k in range(6)]) for v in (value, truth(*q.values()))]
    return np.asarray(means[0] / means[1] - 1)


def nothing(prediction: torch.Tensor) -> None:
    """No error is too large."""


def test_means_at_each_elevation_become_those_of_the_data() -> None:
    """Of light and view, at every level, per color, under skewed noise; held-out directions included."""
    calibration = fit_calibration(wrong, LATTICE, data(150_000, 0.5), HELD_OUT, nothing)
    assert calibration.shape == (2, 4, KNOTS, 3)
    for sigma in (0.5, 0.09):
        for axis in (0, 1):
            assert np.abs(excess(None, sigma, axis)).max() > 0.1
            assert np.abs(excess(calibration, sigma, axis)).max() < 0.02
            assert np.abs(excess(calibration, sigma, axis)).mean() < 0.006


def test_noisy_data_change_the_factors_little() -> None:
    calibration = fit_calibration(truth, LATTICE, data(3000, 3.0), HELD_OUT, nothing)
    assert np.abs(calibration - 1).max() < 0.06
    # Where no data lie, and in black ones.
    black = fit_calibration(
        lambda u, *_: np.zeros((len(u), 3), np.float32), LATTICE, data(3000, 0.0), HELD_OUT, nothing
    )
    np.testing.assert_allclose(black, 1.0)


def test_outliers_do_not_dominate() -> None:
    queries = data(50_000, 0.5)
    kept = fit_calibration(wrong, LATTICE, queries, HELD_OUT, lambda p: 2.0 + 0 * p)
    queries.value[::2500] = 1e6
    found = fit_calibration(wrong, LATTICE, queries, HELD_OUT, lambda p: 2.0 + 0 * p)
    np.testing.assert_allclose(found, kept, atol=0.02)


def test_evaluations_are_bounded() -> None:
    """Those of queries and points together; fewer points leave more queries."""
    evaluated = 0

    def counted(u: F32, *rest: F32) -> F32:
        nonlocal evaluated
        evaluated += len(u)
        return truth(u, *rest)

    queries = data(150_000, 0.5)
    # Points in the held-out region are not evaluated.
    for points, least, most in ((POINTS, 1 << 18, 1 << 19), (4096, len(queries), len(queries) + 5 * 4096)):
        evaluated = 0
        fit_calibration(counted, LATTICE, queries, HELD_OUT, nothing, 1 << 19, most_points=points)
        assert least < evaluated <= most


def test_fits_are_calibrated_by_default(tmp_path: Path) -> None:
    """A fit that is cut short reflects too little at some elevations; its factors say so."""

    def bright(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> F32:
        return np.asarray(np.stack([0.2 + 0.6 * omega_i[:, 2] ** 4] * 3, -1))

    folder = write_data(tmp_path / "shards", bright, train=20_000, test=500, noise=0.1)
    q = random_queries(np.random.default_rng(4), 10_000, Lattice(3))
    q["omega_i"][:, 2] = 0.8
    q["omega_i"][:, :2] *= 0.6 / np.linalg.norm(q["omega_i"][:, :2], axis=1, keepdims=True)
    wanted = 0.2 + 0.6 * 0.8**4
    off = {}
    for calibrate in (True, False):
        training = {"steps": 20, "batch": 2000, "energy_calibration": calibrate}
        config = FitConfig.model_validate({"model": "neumip", "training": training})
        result = fit(config, folder, tmp_path / str(calibrate))
        model = result.material.model
        assert (model.calibration is not None) == calibrate
        off[calibrate] = abs(float(predict(model, *q.values()).mean()) / wanted - 1)
        assert result.material.deviation() < 1e-5
    assert off[False] > 0.08
    assert off[True] < 0.03
