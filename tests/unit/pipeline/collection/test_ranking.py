"""Ranking of methods over materials and seeds, with predictions of foreign code."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fit_data import parallax, write_data

from mbtf_core.stats import Estimate
from mbtf_pipeline.collection.finished_run import FinishedRun
from mbtf_pipeline.collection.ranking import SUBMISSIONS, Entry, ranking
from mbtf_pipeline.collection.recipes import Published
from mbtf_pipeline.tables import Table

NOISE = 0.01
# Errors of three seeds by material and method.
ERRORS = {
    "rock": {"neumip": (0.2, 0.22, 0.18), "relief": (0.1, 0.1, 0.1)},
    "wool": {"neumip": (0.4, 0.4, 0.4), "relief": (0.1, 0.12, 0.08), "svbrdf": (0.8, 0.8, 0.8)},
}


def record(value: float) -> dict[str, Any]:
    unexplained = {"unexplained": {"value": value, "error": NOISE, "n": 100}}
    low = {"unexplained": {"value": 2 * value, "error": NOISE, "n": 10}}
    test = {**unexplained, "n": 100, "elevations": {"0.5-1": unexplained, "0.1-0.5": low}}
    return {
        "splits": {"test": test, "held_out_directions": low},
        **{"training_seconds": 100 * value, "network_weights": 256, "texels": 512},
    }


def make(folder: Path, material: str) -> FinishedRun:
    fits = {
        f"{name}-seed{k}": record(value)
        for name, values in ERRORS[material].items()
        for k, value in enumerate(values)
    }
    pictures = [{"fits": {fit: {"flip": {"ldr": 0.3}} for fit in fits}}]
    comparison = {"fits": list(fits), "test": fits, "pictures": pictures}
    splits = {"train": {"queries": 4, "spp": 2}, "test": {"queries": 3, "spp": 8}}
    manifest = {"layout": "shuffled", "config_hash": 64 * "0", "splits": splits}
    return FinishedRun(material, "", folder / "runs" / material, comparison, manifest)


@pytest.fixture
def runs(tmp_path: Path) -> list[FinishedRun]:
    return [make(tmp_path, material) for material in ERRORS]


def cells(table: Table) -> dict[tuple[Any, ...], dict[str, Any]]:
    """Cells by key of the column, of rows by their names."""
    rows = [dict(zip([c.key for c in table.columns], row, strict=True)) for row in table.rows]
    return {tuple(row[key] for key in ("material", "method") if key in row): row for row in rows}


def test_means_over_seeds_and_materials(runs: list[FinishedRun]) -> None:
    ranked, by_material, _ = map(cells, ranking(runs, []))
    rock = by_material["rock", "neumip"]
    assert rock["seeds"] == 3
    # Standard error of the seeds' mean, and the noise of the test queries that they share.
    spread = math.hypot(0.02 / math.sqrt(3), NOISE)
    assert (rock["unexplained"].value, rock["unexplained"].error) == pytest.approx((0.2, spread))
    assert rock["grazing"].value == pytest.approx(0.4)
    assert rock["new_directions"].value == pytest.approx(0.4)
    assert (rock["flip_ldr"], rock["kib"], rock["training_seconds"]) == pytest.approx((0.3, 3, 20))
    assert by_material["rock", "relief"]["ratio"].value == pytest.approx(0.5)
    relief = ranked["relief",]
    assert relief["materials"] == 2
    # √(0.5 · 0.25), with half of the root of the summed squares of the relative errors.
    parts = [by_material[m, "relief"]["ratio"] for m in ERRORS]
    relative = math.hypot(*(p.error / p.value for p in parts)) / 2
    assert (relief["ratio"].value, relief["ratio"].error) == pytest.approx(
        (math.sqrt(0.125), math.sqrt(0.125) * relative)
    )
    assert relief["unexplained"].value == pytest.approx(0.1)
    assert ranked["neumip",]["ratio"] == Estimate(1.0, 0.0, 2)
    # Of one material alone, and worse than the first there.
    assert list(ranked) == [("relief",), ("neumip",), ("svbrdf",)]
    assert ranked["svbrdf",]["materials"] == 1


def test_significance_and_published_ratios_stand_beside_the_errors(runs: list[FinishedRun]) -> None:
    known = Published(source="a paper", mse={"rock": {"neumip": 4.0, "relief": 1.0}})
    for fit, record in runs[1].comparison["test"].items():
        if fit.startswith("relief"):
            record["splits"]["test"]["unexplained"] = {"value": 0.39, "error": NOISE, "n": 100}
    by_material = cells(ranking(runs, [known])[1])
    assert [by_material["rock", name]["significant"] for name in ("neumip", "relief")] == [None, "yes"]
    assert [by_material["wool", name]["significant"] for name in ("relief", "svbrdf")] == ["no", "yes"]
    assert (by_material["rock", "relief"]["published"], by_material["rock", "relief"]["source"]) == (
        0.25,
        "a paper",
    )
    for run in runs:
        run.comparison["fits"] = [name for name in run.fits if name.endswith("seed0")]
    once = cells(ranking(runs, [])[1])
    assert once["rock", "relief"]["significant"] is None
    assert by_material["rock", "neumip"]["published"] is by_material["wool", "relief"]["published"] is None


def test_an_error_of_unknown_size_is_not_ranked(runs: list[FinishedRun]) -> None:
    assert ranking([], [])[0].rows == []
    runs[0].comparison["test"]["relief-seed1"]["splits"]["test"]["unexplained"]["value"] = None
    ranked, by_material, _ = map(cells, ranking(runs, []))
    assert by_material["rock", "relief"]["unexplained"] is None
    assert ranked["relief",]["ratio"] is None
    assert list(ranked)[-1] == ("relief",)
    assert Entry(runs[0], "none", []).error() is None


def test_data_sets_that_are_made_again_have_equal_digests(runs: list[FinishedRun]) -> None:
    for run, noise in zip(runs, (0.0, 0.1), strict=True):
        write_data(run.folder / "shards", parallax, train=100, test=10, noise=noise)

    def digests() -> list[Any]:
        return [row["shards"] for row in cells(ranking(runs, [])[2]).values()]

    first = digests()
    assert first[0] != first[1]
    write_data(runs[1].folder / "again", parallax, train=100, test=10, noise=0.0)
    shutil.rmtree(runs[1].folder / "shards")
    (runs[1].folder / "again").rename(runs[1].folder / "shards")
    assert digests() == [first[0]] * 2


def test_foreign_predictions_are_ranked_and_faulty_ones_named(
    runs: list[FinishedRun], tmp_path: Path
) -> None:
    write_data(runs[0].folder / "shards", parallax, train=100, test=1000, noise=0.01)
    with np.load(runs[0].folder / "shards" / "test-00000.npz") as arrays:
        value = parallax(*(arrays[name] for name in ("u", "sigma", "omega_i", "omega_o")))
    spread = math.sqrt(value.var(0).mean())
    for name, offset in (("good", 0.1), ("poor", 0.9)):
        folder = tmp_path / SUBMISSIONS / name
        folder.mkdir(parents=True)
        np.savez(folder / "rock.npz", value=value + offset * spread)
    np.savez(tmp_path / SUBMISSIONS / "poor" / "wool.npz", value=value)
    ranked, by_material, _ = map(cells, ranking(runs, []))
    assert by_material["rock", "good"]["unexplained"].value == pytest.approx(0.01, rel=0.3)
    assert by_material["rock", "poor"]["unexplained"].value == pytest.approx(0.81, rel=0.3)
    # Its run has no data set here: the row says so.
    assert "shards" in by_material["wool", "poor"]["unexplained"]
    assert list(ranked) == [("good",), ("relief",), ("neumip",), ("svbrdf",), ("poor",)]
