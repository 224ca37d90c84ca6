"""Comparisons of `benchmarks/gpu.py`: noise passes, wrong values are caught."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scripts import BENCHMARKS, benchmark_module

from mbtf_core.data.lattice import sigma_of_level

FINEST = 3


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return benchmark_module("gpu")


def halves(seed: int, n: int = 4000) -> dict[str, NDArray[np.float32]]:
    """Values of known means with independent noise of 20%."""
    truth, noise = np.random.default_rng(7), np.random.default_rng(seed)
    value = 0.2 + truth.random((n, 3))
    sigma = sigma_of_level(FINEST * truth.random(n))
    arrays = {f"value_{half}": value * (1 + 0.2 * noise.standard_normal((n, 3))) for half in "ab"}
    return {name: a.astype(np.float32) for name, a in (arrays | {"sigma": sigma}).items()}


def failed(checks: list[Any]) -> list[str]:
    return [check.name for check in checks if not check.held]


@pytest.mark.parametrize("seed", range(2))
def test_independent_noise_of_equal_values_passes(gpu: Any, seed: int) -> None:
    checks = gpu.compare_estimates(halves(2 * seed), halves(2 * seed + 1), FINEST)
    assert len(checks) == FINEST + 2
    assert failed(checks) == []


def test_exchanged_queries_of_one_level_are_caught(gpu: Any) -> None:
    """The mean value is the same."""
    other = halves(1)
    chosen = np.flatnonzero(np.round(-np.log2(2 * other["sigma"])) == 2)
    for half in "ab":
        other[f"value_{half}"][chosen] = other[f"value_{half}"][np.roll(chosen, 1)]
    checks = gpu.compare_estimates(halves(0), other, FINEST)
    assert failed(checks) == ["estimator: values of level 2, relative squared"]
