"""Statistics of the card against sums over all numbers in float64, and against the known noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.datasets import NOISE, write_dataset
from support.published import LAYOUTS, small, stored

from mbtf_gen.publishing.statistics import SplitStatistics, split_statistics


@pytest.mark.parametrize("layout", LAYOUTS)
def test_statistics_are_those_of_all_numbers(layout: str, tmp_path: Path) -> None:
    data = small(tmp_path / "data", layout)
    found = split_statistics(data, "train")
    arrays = {name: a.astype(np.float64) for name, a in stored(tmp_path / "data", "train").items()}
    value = 0.5 * (arrays["value_a"] + arrays["value_b"])
    units = value.reshape(len(value), -1, 3).mean(axis=1)
    for channel in range(3):
        mean = found.mean(channel)
        assert mean.value == pytest.approx(units[:, channel].mean(), rel=1e-6)
        error = units[:, channel].std(ddof=1) / np.sqrt(len(units))
        assert mean.error == pytest.approx(error, rel=1e-4)
    variance = (arrays["value_a"] - arrays["value_b"]) ** 2 / 4
    noise = found.noise()
    assert noise is not None
    assert noise.value == pytest.approx(np.sqrt(variance.mean()) / value.mean(), rel=1e-6)
    # The error of the noise by leaving out one unit at a time.
    v = variance.reshape(len(value), -1).mean(axis=1)
    m, n = units.mean(axis=1), len(units)
    left = np.sqrt((v.sum() - v) / (n - 1)) / ((m.sum() - m) / (n - 1))
    assert noise.error == pytest.approx(np.sqrt((n - 1) * left.var()), rel=0.1)
    assert (found.lowest, found.highest) == pytest.approx((value.min(), value.max()), rel=1e-6)
    assert found.queries == arrays["sigma"].size
    assert found.histogram.sum() + found.not_positive.sum() == value.size
    for share in (0.01, 0.5, 0.95):
        assert found.quantile(share) == pytest.approx(np.quantile(value, share), rel=0.07)


def test_noise_per_level_is_the_known_one(tmp_path: Path) -> None:
    """Values have a relative noise of NOISE per estimate, that of their mean is smaller by √2."""
    data = write_dataset(tmp_path / "data", queries={"train": "20000", "test": "100"})
    found = split_statistics(data, "train")
    sigma = stored(tmp_path / "data", "train")["sigma"]
    nearest = np.clip(np.rint(-np.log2(2 * sigma)), 0, data.lattice.finest)
    assert found.level_queries == {k: int((nearest == k).sum()) for k in range(data.lattice.finest + 1)}
    value = stored(tmp_path / "data", "train")
    truth = 0.5 * (value["value_a"] + value["value_b"])
    for level in found.levels:
        noise = found.noise(level)
        assert noise is not None
        mine = truth[nearest == level].astype(np.float64)
        expected = NOISE / np.sqrt(2) * np.sqrt((mine**2).mean()) / mine.mean()
        assert abs(noise.value - expected) < 4 * noise.error
        assert noise.error < 0.1 * noise.value


def test_black_values_are_counted(tmp_path: Path) -> None:
    rows = {name: np.zeros((4, 3), np.float32) for name in ("value_a", "value_b")}
    found = SplitStatistics()
    found.add({**rows, "sigma": np.full(4, 0.25, np.float32)}, 3)
    assert found.not_positive.tolist() == [4, 4, 4]
    assert found.quantile(0.5) == 0.0
    noise = found.noise()
    assert noise is not None
    assert noise.value == 0.0
