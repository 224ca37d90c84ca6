"""What `benchmarks/quality.py` says of the quality that nobody waits for."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.scripts import benchmark_module

from mbtf_fit.training.forecast import PERSISTENCE
from mbtf_gen.config.quality_measured import PresetRun

# `high` at 128² texels; a quarter of its training is two doublings before.
HIGH = PresetRun("rock_cliff", "high", 0.12, 800.0, 100.0, 600.0, 0.12, 0.003, 10**9, 10**6, 1e6, "settings")
QUARTER = replace(HIGH, unexplained=0.15, fit=150.0, seconds=350.0, share=0.25)
# 1600 queries per texel of 4 paths and 262 144 test queries of 128; 400 of 64, and as many of 256.
PATHS = {"high": 1600 * 128**2 * 4 + 262_144 * 128, "paper": 400 * 128**2 * 64 + 262_144 * 256}
QUERIES = {"high": 1600 * 128**2 + 262_144, "paper": 400 * 128**2 + 262_144}
SAMPLES = 30_000 * 2**20


@pytest.fixture(scope="module")
def benchmark() -> Any:
    """The benchmark's module."""
    return benchmark_module("quality")


@pytest.mark.parametrize("doublings", [0, 1, 3])
def test_paper_goes_on_as_the_last_two_doublings_did(benchmark: Any, doublings: int) -> None:
    """Doubling by doubling: the first two gained g and q g of the logarithm, the next ones q² g and on."""
    high = replace(HIGH, queries_per_second=SAMPLES / (600 * 2**doublings))
    found, law = benchmark.paper([QUARTER, high], 128)
    error = QUARTER.unexplained
    gain = (HIGH.unexplained / QUARTER.unexplained) ** (1 / (1 + PERSISTENCE))
    for _ in range(2 + doublings):
        error *= gain
        gain **= PERSISTENCE
    assert found.unexplained == pytest.approx(error, abs=5e-4)
    assert found.fit == pytest.approx(600 * 2**doublings, abs=1)
    assert f"{QUARTER.unexplained:.3f} ± " in law


def test_paper_is_no_better_known_than_what_it_follows_from(benchmark: Any) -> None:
    """Its bar is that of the law with either error moved by its own."""
    pair = [replace(c, unexplained_error=e) for c, e in ((QUARTER, 0.09), (HIGH, 0.02))]

    def moved(number: int) -> float:
        """Slope of the law in one of the errors, by steps small enough to be straight."""
        other = list(pair)
        step = 0.02
        other[number] = replace(pair[number], unexplained=pair[number].unexplained + step)
        at = [benchmark.paper(chains, 128)[0].unexplained for chains in (pair, other)]
        return float((at[1] - at[0]) / step)

    found, _ = benchmark.paper(pair, 128)
    assert found.unexplained_error == pytest.approx(np.hypot(0.09 * moved(0), 0.02 * moved(1)), rel=0.1)


def test_figures_of_other_settings_and_damaged_ones_are_measured_again(
    benchmark: Any, tmp_path: Path
) -> None:
    now = replace(HIGH, settings=benchmark.settings_hash("high"))
    texts = {"now": json.dumps(asdict(now)), "once": json.dumps(asdict(HIGH)), "cut": '{"material": "ro'}
    for name, text in texts.items():
        (tmp_path / f"{name}-128.json").write_text(text)
    assert benchmark.measured(tmp_path / "now-128.json") == now
    assert all(benchmark.measured(tmp_path / f"{name}-128.json") is None for name in ("once", "cut", "none"))
    assert benchmark.kept(tmp_path, 128) == [now]


def test_paper_costs_what_its_paths_and_queries_do(benchmark: Any) -> None:
    found, _ = benchmark.paper([QUARTER, HIGH], 128)
    assert found.quality == "paper"
    assert found.generate == pytest.approx(100 * PATHS["paper"] / PATHS["high"], abs=1)
    assert found.data_bytes == pytest.approx(1e9 * QUERIES["paper"] / QUERIES["high"], rel=1e-6)
    # Start-up and report are those of `high`.
    assert found.seconds == pytest.approx(100 + found.generate + found.fit, abs=2)


@pytest.mark.parametrize("chains", [[], [HIGH], [QUARTER], [replace(HIGH, quality="standard"), QUARTER]])
def test_without_both_runs_nothing_is_said_of_paper(benchmark: Any, chains: list[PresetRun]) -> None:
    found, law = benchmark.paper(chains, 128)
    assert found is None
    assert "±" not in law
