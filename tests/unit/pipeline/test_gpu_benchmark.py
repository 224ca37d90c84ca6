"""`benchmarks/gpu.py` without a GPU: its comparisons, faults, and the CPU against itself."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.paths import ROOT
from support.scripts import BENCHMARKS, benchmark_module

from mbtf_core.child_process import Outcome
from mbtf_core.lattice import sigma_of_level

FINEST = 3


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return benchmark_module("gpu")


def halves(seed: int, n: int = 4000) -> dict[str, NDArray[np.float32]]:
    """Values of known means with independent noise of 20 %."""
    truth, noise = np.random.default_rng(7), np.random.default_rng(seed)
    value = 0.2 + truth.random((n, 3))
    sigma = sigma_of_level(FINEST * truth.random(n))
    arrays = {f"value_{half}": value * (1 + 0.2 * noise.standard_normal((n, 3))) for half in "ab"}
    return {name: a.astype(np.float32) for name, a in (arrays | {"sigma": sigma}).items()}


def failed(checks: list[Any]) -> list[str]:
    return [check.name for check in checks if not check.held]


@pytest.mark.parametrize("seed", range(5))
def test_independent_noise_of_equal_values_passes(gpu: Any, seed: int) -> None:
    checks = gpu.compare_estimates(halves(2 * seed), halves(2 * seed + 1), FINEST)
    assert len(checks) == FINEST + 2
    assert failed(checks) == []


def test_brighter_values_are_caught(gpu: Any) -> None:
    other = halves(1)
    for half in "ab":
        other[f"value_{half}"] *= np.float32(1.03)
    assert "estimator: mean value, relative" in failed(gpu.compare_estimates(halves(0), other, FINEST))


def test_exchanged_queries_of_one_level_are_caught(gpu: Any) -> None:
    """The mean value is the same."""
    other = halves(1)
    chosen = np.flatnonzero(np.round(-np.log2(2 * other["sigma"])) == 2)
    for half in "ab":
        other[f"value_{half}"][chosen] = other[f"value_{half}"][np.roll(chosen, 1)]
    checks = gpu.compare_estimates(halves(0), other, FINEST)
    assert failed(checks) == ["estimator: values of level 2, relative squared"]


class Fake:
    """Plausible answers without work; `edit` changes those of one function on the second device."""

    def __init__(self, gpu: Any, edit: str = "", fault: str = "") -> None:
        self.gpu, self.edit, self.fault = gpu, edit, fault
        self.calls: list[str] = []

    def __call__(self, function: str, arguments: tuple[str, ...], environment: Mapping[str, str]) -> Outcome:
        self.calls.append(function)
        wrong = function == self.edit and arguments[0] == "cuda"
        if wrong and self.fault:
            return Outcome({}, self.fault, 1.0)
        factor = 1.2 if wrong else 1.0
        answers: dict[str, Any] = {"deviation": 0.5 if wrong else 1e-6}
        if function == "selftest":
            answers = {"V-groove": "ok", "CUDA": "absent" if self.edit == function else "ok"}
        elif function in ("estimate", "render"):
            arrays = halves(len(arguments[0]))
            scaled = {name: a * factor for name, a in arrays.items() if name != "sigma"}
            np.savez(arguments[-1], **scaled, sigma=arrays["sigma"])
            answers = {"seconds": 1.0}
        elif function == "train":
            data = halves(0)
            out = Path(arguments[-1])
            out.mkdir()
            truth = 0.2 + np.random.default_rng(7).random((4000, 3))
            prediction = truth + 0.1 * factor * np.random.default_rng(1).standard_normal(truth.shape)
            np.savez(out / self.gpu.PREDICTIONS, prediction=prediction, **data)
        return Outcome(answers, "", 1.0)


def compared(gpu: Any, run: Any, folder: Path) -> Any:
    sizes = gpu.Sizes("nothing", resolution=1 << FINEST)
    comparison = gpu.Comparison(run, "cpu", "cuda", sizes, folder)
    comparison.all()
    return comparison


def test_equal_results_pass(gpu: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    comparison = compared(gpu, Fake(gpu), tmp_path)
    assert failed(comparison.checks) == []
    assert gpu.report(comparison) == 0
    assert '"met": true' in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    ("function", "named"),
    [
        ("selftest", "selftest: CUDA"),
        ("estimate", "estimator: mean value, relative"),
        ("render", "picture of relief: mean value, relative"),
        ("train", "error of relief, begun, by the device cuda, relative"),
        ("infer", "conformance of hierarchical on the device cuda, PyTorch"),
        ("evaluate_plugin", "conformance of relief on the device cuda, half"),
    ],
)
def test_a_wrong_result_is_caught(
    gpu: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], function: str, named: str
) -> None:
    comparison = compared(gpu, Fake(gpu, function), tmp_path)
    assert named in failed(comparison.checks)
    assert gpu.report(comparison) == 1
    assert '"met": false' in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.slow
def test_the_cpu_agrees_with_itself(gpu: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The measurements themselves, in this process, of one model."""
    measurements = sys.modules["gpu_measurements"]
    monkeypatch.setattr(gpu, "models", lambda layout: ["relief"] if layout == "shuffled" else [])

    def here(function: str, arguments: tuple[str, ...], environment: Mapping[str, str]) -> Outcome:
        answers: dict[str, Any] = {}
        if function != "selftest":
            for found in getattr(measurements, function)(*arguments):
                answers |= found
        return Outcome(answers, "", 0.0)

    sizes = gpu.Sizes(
        str(ROOT / "assets" / "cliff_rock"), resolution=8, train=20, test=256, spp=4, images=1,
        steps=5, batch=256, rows=9, columns=16,
    )  # fmt: skip
    comparison = gpu.Comparison(here, "cpu", "cpu", sizes, tmp_path)
    comparison.all()
    assert failed(comparison.checks) == []
    assert len(comparison.checks) == 1 + FINEST + 1 + 4 + 8 + 2
    assert comparison.figures["estimator on the device cpu"]["paths_per_second"] > 0
