"""A budget is spent as it says, and the same command spends it the same way."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.console import clock
from mbtf_core.errors import InputError, UsageError
from mbtf_core.stats import Estimate
from mbtf_core.units import parse_duration
from mbtf_fit.config import FitConfig
from mbtf_fit.data.queries import QUERY_BYTES
from mbtf_gen.job import split_queries
from mbtf_gen.planning.run_plan import RunPlan
from mbtf_pipeline.cost_study import time_split as module
from mbtf_pipeline.cost_study.time_split import (
    LARGEST_SHARE,
    LEAST_SHARE,
    SHARES,
    USUAL_SHARE,
    best_share,
    split_budget,
    within_budget,
)
from mbtf_pipeline.recipe import Recipe, load_recipe

# Seconds of a training query, of the test split, and of starting.
PRICE, TEST, START = 2e-6, 3.0, 1.5
# Seconds of a fit besides training, and of that by training query.
FIT, FIT_QUERY = 4.0, 5e-7


def recipe(**fits: str) -> Recipe:
    said = [f"fit.{name}.model={model}" for name, model in fits.items()]
    return load_recipe(ROOT / "pipelines" / "quickstart.yaml", said)


def point(error: float, queries: int = 4096, training: float = 0.0) -> Any:
    """A pilot chain as the workshop makes it."""
    details = {"generation_seconds": queries * PRICE, "training_seconds": training}
    total = sum(details.values()) + FIT + queries * FIT_QUERY
    return SimpleNamespace(error=Estimate(error, 0.01, 10), details={**details, "total_seconds": total})


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float]]:
    """Neither forecasts nor pilots run: prices are as above, the clock stands still, and a chain's error is
    least where half of its time generates. Gives (queries, training seconds) of the chains asked for."""
    chains: list[tuple[int, float]] = []

    def forecast(job: Any, plan: Any) -> Any:
        seconds = split_queries(job, "train") * PRICE + TEST
        return SimpleNamespace(query_seconds=PRICE, seconds=seconds, start=START)

    def measure(self: Any, chain: Any) -> Any:
        generating, training = chain.data.queries * PRICE, parse_duration(chain.fit["training"]["time"])
        chains.append((chain.data.queries, training))
        error = 0.1 * math.exp(math.log(generating / training) ** 2)
        return point(error, chain.data.queries, training)

    monkeypatch.setattr("mbtf_gen.forecast.forecast", forecast)
    monkeypatch.setattr("mbtf_gen.planning.run_plan.allocate", lambda job, effects: RunPlan(effects))
    monkeypatch.setattr("mbtf_pipeline.cost_study.runs.RunRunner.measure", measure)
    monkeypatch.setattr(module.time, "perf_counter", lambda: 0.0)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e15))
    monkeypatch.setattr(module, "physical_memory", lambda: 1e15)
    return chains


@pytest.mark.parametrize("best", [0.1, 0.2, 0.35, 0.5])
def test_the_share_is_where_a_parabola_is_least(best: float) -> None:
    pilots = [(s, 0.3 * math.exp(0.2 * math.log(s / best) ** 2)) for s in SHARES]
    assert best_share(pilots) == pytest.approx(best)


def test_shares_that_no_pilot_speaks_for_are_not_taken() -> None:
    # Errors that only rise, only fall, or have a greatest value; one that noise made negative.
    for errors in ((1, 2, 4), (4, 2, 1), (1, 3, 1.5), (1.5, 3, 1), (0.1, -0.01, 0.2)):
        share = best_share(list(zip(SHARES, errors, strict=True)))
        assert LEAST_SHARE <= share <= LARGEST_SHARE
        assert SHARES[0] / 1.6 < share < SHARES[-1] * 1.4
    assert best_share([(0.15, 1.0), (0.35, 3.0), (0.6, 1.5)]) == 0.15


def test_errors_that_follow_a_power_of_the_share_have_no_least_value() -> None:
    """In logarithms they lie on a line but for rounding, whose bend may point either way."""
    for power in np.linspace(-1.0, 1.0, 41):
        share = best_share([(s, 0.2 * s**power) for s in SHARES])
        assert LEAST_SHARE <= share <= LARGEST_SHARE
        if abs(power) > 0.01:
            assert (share <= SHARES[0]) == (power > 0)


def test_pilots_that_have_nothing_to_explain_do_not_decide(
    measured: list[tuple[int, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The data of an even plane have no variance that an error could be a share of."""
    nothing = point(math.nan)
    monkeypatch.setattr("mbtf_pipeline.cost_study.runs.RunRunner.measure", lambda self, chain: nothing)
    split = split_budget(recipe(), 1000.0, tmp_path / "run", "command", lambda note: None)
    assert split.share == USUAL_SHARE
    assert split.pilots == ()


def test_long_budgets_are_split_by_pilots(measured: list[tuple[int, float]], tmp_path: Path) -> None:
    notes: list[str] = []
    split = split_budget(recipe(), 1000.0, tmp_path / "run", "command", notes.append)
    assert [t for _, t in measured] == pytest.approx([40 * (1 - s) for s in SHARES], rel=0.01)
    assert [n * PRICE for n, _ in measured] == pytest.approx([40 * s for s in SHARES], rel=0.1)
    assert len(notes) == len(split.pilots) == 3
    # Half and half by the pilots; queries are rounded down to two digits.
    assert split.share == pytest.approx(0.5, abs=0.06)
    # Both fits load what is made.
    assert split.prices.fit == pytest.approx(FIT)
    assert split.prices.fit_query == pytest.approx(FIT_QUERY)
    assert split.generating + split.training + split.beside == pytest.approx(1000.0, rel=0.01)
    making = split.generating - TEST - START
    assert making / (making + split.training) == pytest.approx(split.share, rel=1e-3)
    assert 0.9 * making < split.queries * PRICE <= making + 0.1
    assert split.beside == pytest.approx(2 * (FIT + FIT_QUERY * split.queries))
    assert f"{clock(split.beside)} beside it" in split.describe()


def test_pilots_are_paid_by_the_budget(
    measured: list[tuple[int, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module.time, "perf_counter", lambda: 15.0 * len(measured))
    split = split_budget(recipe(), 1000.0, tmp_path / "run", "command", lambda note: None)
    assert split.pilot_seconds == 45.0
    spent = split.generating + split.training + split.beside + split.pilot_seconds
    assert spent == pytest.approx(1000.0, rel=0.01)


def test_a_pilot_that_fails_leaves_the_usual_share(
    measured: list[tuple[int, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Any, chain: Any) -> Any:
        raise InputError("training diverged at step 7", hint="lower the rate")

    monkeypatch.setattr("mbtf_pipeline.cost_study.runs.RunRunner.measure", fail)
    notes: list[str] = []
    split = split_budget(recipe(), 1000.0, tmp_path / "run", "command", notes.append)
    assert split.share == USUAL_SHARE
    assert "training diverged at step 7; 35% of the time" in notes[0]


def test_pilots_train_where_the_fit_does(
    measured: list[tuple[int, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options: list[dict[str, Any]] = []

    def measure(self: Any, chain: Any) -> Any:
        options.append(chain.fit)
        return point(0.1)

    monkeypatch.setattr("mbtf_pipeline.cost_study.runs.RunRunner.measure", measure)
    said = ["fit.neumip.device=cpu", "fit.neumip.data.memory=3 GB"]
    asked = load_recipe(ROOT / "pipelines" / "quickstart.yaml", said)
    split_budget(asked, 1000.0, tmp_path / "run", "command", lambda note: None)
    for found in options:
        config = FitConfig.model_validate(found)
        assert (config.device, config.data.memory) == ("cpu", 3e9)


def test_short_budgets_take_the_usual_share(measured: list[tuple[int, float]], tmp_path: Path) -> None:
    split = split_budget(recipe(), 100.0, tmp_path / "run", "command", lambda note: None)
    assert not measured
    assert split.share == USUAL_SHARE
    assert split.generating + split.training == pytest.approx(100.0, abs=0.2)


@pytest.mark.parametrize("scarce", ["disk", "memory"])
def test_disk_and_memory_bound_the_queries(
    measured: list[tuple[int, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scarce: str
) -> None:
    """Queries that cost next to nothing would fill the disk in any time, which goes to training instead."""
    monkeypatch.setattr(f"{__name__}.PRICE", 1e-12)
    if scarce == "disk":
        monkeypatch.setattr(module.shutil, "disk_usage", lambda path: SimpleNamespace(free=8e7))
    else:
        monkeypatch.setattr(module, "physical_memory", lambda: 10e6)
    asked = load_recipe(ROOT / "pipelines" / "quickstart.yaml", ["fit.neumip.data.memory=20 MB"])
    split = split_budget(asked, 1000.0, tmp_path / "run", "command", lambda note: None)
    # A quarter of the disk, 68 bytes a query; or what the fit may hold, more than half the memory.
    most = 20e6 / (68 if scarce == "disk" else QUERY_BYTES)
    assert 0.9 * most < split.queries <= most
    assert [n for n, _ in measured] == [split.queries] * 3
    assert split.generating + split.training + split.beside == pytest.approx(1000.0, abs=0.5)
    assert split.training > 985.0


def test_fits_share_the_time_of_training(measured: list[tuple[int, float]], tmp_path: Path) -> None:
    asked = recipe()
    split = split_budget(asked, 100.0, tmp_path / "run", "command", lambda note: None)
    spent = within_budget(asked, split)
    assert spent.generate.queries.train == str(split.queries)
    assert len(spent.fit) == 2
    assert sum(fit.training.time for fit in spent.fit.values()) == pytest.approx(split.training, abs=0.2)
    assert all(fit.training.steps is None for fit in spent.fit.values())
    # Everything else is the recipe's.
    assert spent.compare == asked.compare
    assert spent.generate.light == asked.generate.light


def test_the_same_command_goes_on_with_the_same_split(
    measured: list[tuple[int, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    first = split_budget(recipe(), 1000.0, folder, "command", lambda note: None)
    monkeypatch.setattr(f"{__name__}.PRICE", 3e-6)
    assert split_budget(recipe(), 1000.0, folder, "command", lambda note: None) == first
    # Another budget, other options, or a damaged record: looked at anew.
    assert split_budget(recipe(), 900.0, folder, "command", lambda note: None) != first
    again = split_budget(recipe(), 1000.0, folder, "command", lambda note: None)
    assert again.queries < first.queries
    (folder / module.BUDGET_NAME).write_text('{"format": "mbtf-budget"}')
    assert split_budget(recipe(), 1000.0, folder, "command", lambda note: None) == again


def test_what_cannot_be_split_is_refused(measured: list[tuple[int, float]], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="too short"):
        split_budget(recipe(), 5.0, tmp_path / "run", "command", lambda note: None)
    with pytest.raises(UsageError, match="layout"):
        split_budget(recipe(h="hierarchical"), 100.0, tmp_path / "run", "command", lambda note: None)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").write_text("")
    with pytest.raises(InputError, match="holds no run"):
        split_budget(recipe(), 100.0, tmp_path / "other", "command", lambda note: None)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("seconds", "line"),
    [((4.0, 5.0, 7.0), (3.0, 1.0)), ((5.0, 5.0, 5.0), (5.0, 0.0)), ((7.0, 5.0, 4.0), (16 / 3, 0.0))],
)
def test_what_fits_take_besides_training_never_falls(
    seconds: tuple[float, ...], line: tuple[float, float]
) -> None:
    found = module._line(list(zip((1.0, 2.0, 4.0), seconds, strict=True)))
    assert found == pytest.approx(line)


def test_less_than_nothing_is_never_taken() -> None:
    # Rising more steeply than from 0 up: noise.
    fixed, slope = module._line([(1.0, 0.0), (2.0, 1.0), (4.0, 5.0)])
    assert fixed == pytest.approx(0.0, abs=1e-12)
    assert slope == pytest.approx(2.0 / (7 / 3))
