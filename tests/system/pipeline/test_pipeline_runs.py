"""A small recipe end to end: outputs, resuming, and a self-contained report."""

from __future__ import annotations

import base64
import json
import math
import re
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import RunPython
from support.pages import loads
from support.paths import ROOT

from mbtf_core.app.console import run
from mbtf_core.directions import from_angles
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.compare.image_files import read_picture

RECIPE = ROOT / "pipelines" / "ci.yaml"
STAGES = ["generate", "fit neumip", "compare", "report"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pipeline") / "ci"


@pytest.fixture(scope="module")
def first(folder: Path, run_python: RunPython) -> dict[str, Any]:
    """Output of the first run in a process of its own."""
    done = run_python("-m", "mbtf_pipeline", "run", str(RECIPE), "-o", str(folder), "--json", "-q")
    assert done.returncode == 0, done.stderr
    out: dict[str, Any] = json.loads(done.stdout)
    return out


@pytest.fixture
def again(first: dict[str, Any], folder: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs the recipe again in the same folder; returns the reasons of the stages that ran."""

    def execute(*options: str) -> dict[str, str]:
        capsys.readouterr()
        assert run(app, ["run", str(RECIPE), "-o", str(folder), "--json", "-q", *options]) == 0
        stages = json.loads(capsys.readouterr().out)["stages"]
        assert list(stages) == STAGES
        return {name: s["reason"] for name, s in stages.items() if s["ran"]}

    return execute


def test_a_run_ends_with_the_page_of_its_fits(first: dict[str, Any], folder: Path) -> None:
    assert Path(first["viewer"]) == folder / "viewer.html"
    html = (folder / "viewer.html").read_text()
    assert loads(html).external == []
    content = json.loads(re.search(r'<script id="content"[^>]*>(.*?)</script>', html, re.DOTALL)[1])  # type: ignore[index]
    assert [m["name"] for m in content["materials"]] == ["neumip"]
    record = json.loads((folder / "compare" / "comparison.json").read_text())
    assert len(content["pictures"]) == min(4, len(record["pictures"]))
    light, picture = record["pictures"][0]["light"], content["pictures"][0]
    np.testing.assert_allclose(picture["light"], from_angles(light["elevation"], light["azimuth"]), atol=1e-6)


def test_every_stage_runs_and_the_material_is_learned(first: dict[str, Any], folder: Path) -> None:
    assert {name: s["ran"] for name, s in first["stages"].items()} == dict.fromkeys(STAGES, True)
    assert Path(first["report"]) == folder / "report.html"
    share = first["test"]["neumip"]["unexplained_variance"]
    assert first["test"]["neumip"]["advice"]
    # 1 is the error of the best constant.
    assert share["value"] + 3 * share["error"] < 0.5


def test_images_and_numbers_are_consistent(first: dict[str, Any], folder: Path) -> None:
    record = json.loads((folder / "compare" / "comparison.json").read_text())
    assert [p["name"] for p in record["pictures"]] == ["v1-l1-s1", "v2-l1-s1"]
    for picture in record["pictures"]:
        reference = read_picture(folder / "compare" / picture["references"]["query"]["file"])
        made = picture["fits"]["neumip"]
        fit = read_picture(folder / "compare" / made["file"])
        assert reference.shape == fit.shape == (48, 48, 3)
        assert np.isfinite(reference).all()
        mse = made["errors"]["query"]["mse"]
        # The plain error includes the noise of the reference.
        plain = float(np.mean((fit.astype(np.float64) - reference) ** 2))
        assert mse["value"] - 4 * mse["error"] < plain
        assert made["errors"]["query"]["psnr"]["value"] == pytest.approx(
            10 * np.log10(record["white"] ** 2 / mse["value"])
        )
        # Both references converge to one image.
        between = picture["between_references"]
        assert abs(between["value"]) < 4 * between["error"]
    splits = record["test"]["neumip"]["splits"]
    assert set(splits) == {"test", "held_out_queries", "held_out_directions", "training"}
    assert sum(g["mse"]["n"] for g in splits["test"]["levels"].values()) == splits["test"]["n"] == 4096


def test_the_report_is_self_contained(first: dict[str, Any], folder: Path) -> None:
    html = (folder / "report.html").read_text(encoding="utf-8")
    page = loads(html)
    assert page.external == []
    assert len(html) < 10e6
    # Two scenes with two references, a fit and its two maps each; one traced and one learned offset; one map.
    embedded = [p for p in page.pictures if p]
    assert len(embedded) == 2 * 5 + 2 + 1
    for uri in embedded:
        head, _, data = uri.partition(",")
        assert head in ("data:image/png;base64", "data:image/jpeg;base64")
        assert len(base64.b64decode(data, validate=True)) > 100
    assert html.count("<svg") >= 6
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))


def test_other_images_keep_data_and_fit(again: Any) -> None:
    ran = again("--set", "compare.spp=16")
    assert list(ran) == ["compare", "report"]
    assert "spp: 32 -> 16" in ran["compare"]
    assert again("--set", "compare.spp=16") == {}
    assert list(again()) == ["compare", "report"]


def test_another_title_keeps_the_images(again: Any, folder: Path) -> None:
    assert list(again("--set", "report.title=A <b> & c")) == ["report"]
    assert "<h1>A &lt;b&gt; &amp; c</h1>" in (folder / "report.html").read_text()
    assert list(again()) == ["report"]


def test_a_flipped_byte_is_detected_and_repaired(again: Any, folder: Path) -> None:
    shard = folder / "shards" / "test-00000.npz"
    whole = shard.read_bytes()
    middle = len(whole) // 2
    shard.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    ran = again()
    assert list(ran) == STAGES
    assert ran["generate"] == "shards/test-00000.npz has changed"
    assert shard.read_bytes() == whole


def test_the_report_can_be_written_again(
    again: Any, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "report.html").unlink()
    assert run(app, ["report", str(folder)]) == 0
    assert (folder / "report.html").exists()
    assert again() == {}
    capsys.readouterr()
    assert run(app, ["report", str(folder), "--exposure", "-0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["exposure"] == -0.5
    assert run(app, ["report", str(folder), "--exposure", "90"]) == 2
    # The recipe has its own exposure.
    assert list(again()) == ["report"]


def test_a_cost_study_measures_reports_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two configurations of the generator, then a third one and a run."""
    from mbtf_pipeline.cost import study
    from mbtf_pipeline.cost.generator import generator_configurations
    from mbtf_pipeline.cost.runs import planned_runs

    some, runs = 2, 0
    all_of = generator_configurations
    monkeypatch.setattr(study, "generator_configurations", lambda benchmark: islice(all_of(benchmark), some))
    monkeypatch.setattr(study, "planned_runs", lambda *arguments: planned_runs(30.0, *arguments[1:])[:1])
    monkeypatch.setattr(study.Measurements, "expected_seconds", lambda *_: 0.0 if runs else math.inf)
    monkeypatch.setattr("mbtf_pipeline.cost.measurement._CONFIGURATIONS", 1000)
    monkeypatch.setattr("mbtf_pipeline.cost.runs.SHORTEST", 4.0)
    monkeypatch.setattr("mbtf_pipeline.cost.runs.FEWEST_STEPS", 2)
    monkeypatch.setattr("mbtf_pipeline.cost.runs.TEST", (16384, 32))
    out = tmp_path / "study"
    # Long enough never to decide what is measured.
    command = ["cost", str(RECIPE), "--time", "1h", "-o", str(out), "--json", "--quiet"]
    assert run(app, command) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["measurements"] == 2
    stored = {p: p.read_bytes() for p in (out / "measurements").iterdir()}
    assert (out / "paths.png").stat().st_size > 1000
    # The same command with more to do keeps what was measured.
    some, runs = 3, 1
    assert run(app, command) == 0
    second = json.loads(capsys.readouterr().out)
    assert second["measurements"] == 4
    assert all(p.read_bytes() == content for p, content in stored.items())
    assert not (out / ".work").exists()
    (point,) = second["front"]
    assert 0 < point["unexplained"]["error"] < point["unexplained"]["value"]
    assert " && mbtf-fit run-" in point["command"]
    html = (out / "cost.html").read_text()
    assert not loads(html).external
    assert len((out / "cost.csv").read_text().splitlines()) == 1 + 4
