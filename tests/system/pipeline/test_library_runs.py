"""A library: runs of several materials, one of them broken, in processes and on workers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.small_runs import contents

from mbtf_core.console import run
from mbtf_pipeline.cli.app import app

RECIPE = """
name: test
library: [materials]
training: 4s
base:
  generate:
    queries: {train: 100/texel, resolution: 8, test: "1024", test_spp: 16, min_cos: 0.3}
    light: {width: 10}
  fit:
    neumip: {training: {batch: 1024}}
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
    (folder / "library.yaml").write_text(RECIPE)
    return folder


def record(out: Path) -> dict[str, dict[str, object]]:
    found = json.loads((out / "library.json").read_text())
    return {material["name"]: material for material in found["materials"]}


def test_failures_are_named_and_the_rest_is_kept(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "out"
    line = ["run", str(folder / "library.yaml"), "-o", str(out), "-q"]
    assert run(app, line) == 4
    assert "1 of 3 materials failed" in capsys.readouterr().err
    found = record(out)
    assert {name: material["state"] for name, material in found.items()} == {
        **{"broken": "failed", "flat": "done", "rough": "done"}
    }
    assert "height.png" in str(found["broken"]["error"])
    page = (out / "library.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 4
    assert "height.png" in page
    for name in ("flat", "rough"):
        assert f'href="materials/{name}/report.html"' in page
        assert (out / "materials" / name / "report.html").is_file()
    first = json.loads((out / "library.json").read_text())["first"]
    assert set(first["errors"]) == {"flat", "rough"}
    # The times of both fits are recorded, and sum to what the first fits left.
    times = {n: json.loads((out / f"materials/{n}/fits/neumip/fit.json").read_text()) for n in first["times"]}
    assert sum(first["times"].values()) == pytest.approx(4.0 - 2 * 0.2 * 4.0 / 2, abs=0.5)
    for name, fit in times.items():
        assert str(first["times"][name]).rstrip("0").rstrip(".") in str(fit["config"]["training"]["time"])
    # Repaired, it runs, and the others are not run again.
    kept = {n: (out / f"materials/{n}/fits/neumip/weights.safetensors").stat().st_mtime_ns for n in times}
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(folder / "materials" / "broken" / "height.png")
    assert run(app, line) == 0
    assert record(out)["broken"]["state"] == "done"
    for name, time in kept.items():
        path = out / f"materials/{name}/fits/neumip/weights.safetensors"
        assert (path.stat().st_mtime_ns == time) or name == "broken"
    assert run(app, ["report", str(out), "-q"]) == 0


def test_workers_make_the_same_data(folder: Path) -> None:
    pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")
    out = folder / "clustered"
    line = ["run", str(folder / "library.yaml"), "-o", str(out), "-q", "--cluster", "local:2"]
    assert run(app, line) in (0, 4)
    assert record(out)["rough"]["state"] == "done"
    own, clustered = (contents(folder / f / "materials/rough/shards") for f in ("out", "clustered"))
    assert own == clustered


def test_options_of_single_runs_are_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for option in (["--quick"], ["--time", "1min"], ["--quality", "draft"]):
        assert run(app, ["run", str(folder / "library.yaml"), *option]) == 2
        assert "library of materials" in capsys.readouterr().err
