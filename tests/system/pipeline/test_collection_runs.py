"""Recipes of many materials from maps to page and CSV: missing and broken ones are named, all resumes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
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


LIBRARY = """
name: test
library: [materials]
base:
  generate:
    queries: {train: 100/texel, resolution: 8, test: "1024", test_spp: 16, min_cos: 0.3}
    light: {width: 10}
  fit:
    neumip: {training: {time: 1s, batch: 1024}}
  compare:
    views: [{elevation: 60, azimuth: -90}]
    lights: [{elevation: 50, azimuth: 45}]
    tiles_across: [2]
    size: 32
    spp: 16
    offset_views: [{elevation: 30, azimuth: 0}]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe beside two materials, of which one is displaced, and a broken one."""
    folder = tmp_path_factory.mktemp("library")
    rng = np.random.default_rng(2)
    for name, height in (("flat", 0.0), ("rough", 0.1)):
        maps = folder / "materials" / name
        maps.mkdir(parents=True)
        np.save(maps / "height.npy", (height * rng.random((8, 8))).astype(np.float32))
        Image.fromarray(rng.integers(20, 230, (8, 8, 3)).astype(np.uint8)).save(maps / "base_color.png")
    broken = folder / "materials" / "broken"
    broken.mkdir()
    (broken / "height.png").write_bytes(b"no picture")
    (folder / "library.yaml").write_text(LIBRARY)
    return folder


def record(out: Path) -> dict[str, dict[str, object]]:
    found = json.loads((out / "collection.json").read_text())
    return {run["name"]: run for run in found["runs"]}


def weights(out: Path, *names: str) -> dict[str, int]:
    """When the fits of materials were written."""
    paths = [out / "runs" / name / "fits" / "neumip" for name in names]
    return {str(path): (path / "weights.safetensors").stat().st_mtime_ns for path in paths}


def test_failures_are_named_and_the_rest_is_kept(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "out"
    line = ["run", str(folder / "library.yaml"), "-o", str(out), "-q"]
    assert run(app, line) == 4
    assert "1 of 3 runs failed" in capsys.readouterr().err
    found = record(out)
    assert {name: material["state"] for name, material in found.items()} == {
        **{"broken": "failed", "flat": "done", "rough": "done"}
    }
    assert "height.png" in str(found["broken"]["error"])
    page = (out / "library.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 4
    assert "height.png" in page
    for name in ("flat", "rough"):
        assert f'href="runs/{name}/report.html"' in page
        assert (out / "runs" / name / "report.html").is_file()
    # Repaired, it runs, and the others are not run again.
    kept = weights(out, "flat", "rough")
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(folder / "materials" / "broken" / "height.png")
    assert run(app, line) == 0
    assert record(out)["broken"]["state"] == "done"
    assert weights(out, "flat", "rough") == kept
    assert run(app, ["report", str(out), "-q"]) == 0
