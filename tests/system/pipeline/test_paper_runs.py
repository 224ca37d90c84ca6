"""A paper recipe from maps to page and CSV: both layouts, a missing material, and resuming."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.pages import loads

from mbtf_core.app.console import run
from mbtf_pipeline.cli.app import app

RECIPE = """\
name: tiny
title: A tiny comparison
tables: [methods, levels, ablations, timing]
materials:
  bumps: bumps.npy
  elsewhere: nowhere/maps
base:
  generate:
    geometry: {height_scale: 0.1, mesh: 16}
    queries: {train: 100/texel, spp: 2, test: "512", test_spp: 16, resolution: 4, min_cos: 0.3}
    light: {width: 10}
  each_fit:
    training: {steps: 400, batch: 512}
  fit: {neumip-baseline: , neumip: , hierarchical: {network: {encoding: {position: 0, direction: 0}}}}
  compare:
    views: [{elevation: 80, azimuth: -90}]
    lights: [{elevation: 50, azimuth: 40}]
    tiles_across: [0.5, 2]
    size: 16
    spp: 8
    kinds: [query, pixel]
    offset_views: [{elevation: 40, azimuth: 0}]
    st_lpips: false
    timing: true
quick:
  each_fit: {training: {steps: 4}}
"""


def command(folder: Path, *options: str) -> list[str]:
    return ["run", str(folder / "tiny.yaml"), "--quick", "-o", str(folder / "out"), "--json", "-q", *options]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished quick run; timings use few pixels."""
    folder = tmp_path_factory.mktemp("paper")
    np.save(folder / "bumps.npy", np.random.default_rng(1).random((8, 8)).astype(np.float32))
    (folder / "tiny.yaml").write_text(RECIPE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mbtf_pipeline.compare.compare._TIMED_PIXELS", 8 * 81)
        assert run(app, command(folder)) == 0
    return folder


def table(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / "out" / "tables" / f"{name}.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_tables_contain_the_measured_numbers(made: Path) -> None:
    record: dict[str, Any] = json.loads((made / "out" / "collection.json").read_text())
    assert record["size"] == "quick"
    assert {run["name"]: run["state"] for run in record["runs"]} == {"bumps": "done", "elsewhere": "skipped"}
    methods = table(made, "methods")
    assert [r["method"] for r in methods[:3]] == ["neumip-baseline", "neumip", "hierarchical"]
    assert len(methods) == 3
    run_folder = made / "out" / "runs" / "bumps"
    comparison = json.loads((run_folder / "compare" / "comparison.json").read_text())
    for row in methods[:3]:
        mse = comparison["test"][row["method"]]["splits"]["test"]["mse"]
        assert float(row["mse"]) == pytest.approx(mse["value"], rel=1e-5)
        assert mse["n"] == 512
    assert len(table(made, "levels")) == 3
    assert len(table(made, "timing")) == 3
    for fit in ("neumip", "hierarchical"):
        begun = json.loads((run_folder / "fits" / fit / "fit.json").read_text())
        assert begun["depends"]["training"]["steps"] == 4


def test_the_page_is_self_contained_and_names_the_size(made: Path) -> None:
    html = (made / "out" / "paper.html").read_text()
    found = loads(html)
    assert not found.external
    assert len(found.pictures) == 4
    assert all(p.startswith("data:image/") for p in found.pictures)
    assert "Skipped because of missing files: elsewhere" in html


def test_the_same_command_runs_nothing_again(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamps = {p: p.stat().st_mtime_ns for p in (made / "out" / "runs").rglob("stages/*.json")}
    assert len(stamps) == 7
    page, rows = made / "out" / "paper.html", made / "out" / "tables" / "methods.csv"
    before = page.read_bytes(), rows.read_bytes()
    page.unlink()
    capsys.readouterr()
    assert run(app, command(made)) == 0
    assert [run["state"] for run in json.loads(capsys.readouterr().out)["runs"]] == ["done", "skipped"]
    assert {p: p.stat().st_mtime_ns for p in stamps} == stamps
    rows.unlink()
    assert run(app, ["report", str(made / "out")]) == 0
    assert (page.read_bytes(), rows.read_bytes()) == before
