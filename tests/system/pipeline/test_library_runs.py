"""A library: runs of several materials, one of them broken, in processes and on workers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mbtf_core.app.console import run
from mbtf_pipeline.cli.app import app

RECIPE = """
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
    (folder / "library.yaml").write_text(RECIPE)
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
