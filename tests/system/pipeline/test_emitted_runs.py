"""Emitted jobs with the programs themselves: by make, and by a SLURM of one node.

The SLURM is that of `tests/system/slurm/`; its tests need root, and Debian's packages slurm-wlm and munge.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.emitted import install_programs, make_place, start
from support.fake_cluster import PROGRAMS, calls, fail, install
from support.paths import ROOT
from support.slurm import slurm_node
from support.small_runs import contents

from mbtf_core.app.console import run
from mbtf_pipeline.cli.app import app

RECIPE = """
name: small
generate:
  material: height.exr
  geometry: {mesh: 64}
  queries: {train: 400/texel, spp: 4, test: "4096", test_spp: 64, resolution: 16, min_cos: 0.3}
  light: {width: 10}
  output: {shard_queries: 20000}
fit:
  neumip: {training: {steps: 20, batch: 2048}}
  baseline: {model: neumip-baseline, training: {steps: 20, batch: 2048}}
compare:
  views: [{elevation: 90, azimuth: -90}]
  lights: [{elevation: 50, azimuth: 45}]
  tiles_across: [2]
  size: 32
  spp: 16
  offset_views: [{elevation: 30, azimuth: 0}]
"""
HEIGHTS = ROOT / "assets" / "turtle_shell" / "height.exr"


def write_recipe(folder: Path) -> None:
    (folder / "recipe.yaml").write_text(RECIPE)
    shutil.copy(HEIGHTS, folder)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run on one machine, beside its recipe."""
    folder = tmp_path_factory.mktemp("plain")
    write_recipe(folder)
    environment = install_programs(folder / "bin")
    command = ["mbtf-pipeline", "run", "recipe.yaml", "-o", "run", "-q"]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=300, check=False, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "a folder"
    folder.mkdir()
    write_recipe(folder)
    monkeypatch.chdir(folder)
    return folder


def check_run(made: Path, plain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Data and fits are those of one machine, and a run finds nothing left to do."""
    assert contents(made / "shards") == contents(plain / "shards")
    assert len(list((made / "shards").glob("train-*.npz"))) == 6
    for fit in ("neumip", "baseline"):
        weights = "weights.safetensors"
        assert (made / "fits" / fit / weights).read_bytes() == (plain / "fits" / fit / weights).read_bytes()
        # The last job, which writes the record of the run again, has not trained.
        assert (made / "fits" / fit / weights).stat().st_mtime < (made / "run.json").stat().st_mtime
    assert (made / "report.html").exists()
    record = json.loads((made / "shards" / "manifest.json").read_text())
    stamp = json.loads((made / "stages" / "generate.json").read_text())
    # Reports count what the jobs took, not the look at what they made.
    assert stamp["seconds"] >= record["summary"]["shard_seconds"]
    capsys.readouterr()
    assert run(app, ["run", "recipe.yaml", "-o", str(made), "--json", "-q"]) == 0
    assert not any(stage["ran"] for stage in json.loads(capsys.readouterr().out)["stages"].values())


def test_make_gives_the_data_and_fits_of_one_machine(
    place: Path, plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(app, ["emit", "recipe.yaml", "--to", "make", "--slices", "2", "-q"]) == 0
    environment = install_programs(tmp_path / "bin")
    first = start("make -C jobs generate-2", environment)
    assert first.returncode == 0, first.stderr
    # A slice that is missing is named, and stops nothing for good.
    merged = start("mbtf-gen merge out/small/shards", environment)
    assert merged.returncode == 4
    assert "unfinished: run the other slices" in merged.stdout
    done = start("make -C jobs -j2", environment)
    assert done.returncode == 0, done.stderr
    check_run(place / "out/small", plain, capsys)


@pytest.mark.slow
def test_pods_give_the_data_and_fits_of_one_machine(
    place: Path, plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands of the pods with the programs, by a stand-in of kubectl."""
    words = ["--slices", "2", "--image", "mbtf", "-q"]
    assert run(app, ["emit", "recipe.yaml", "--to", "k8s", *words]) == 0
    programs = install_programs(tmp_path / "bin")
    scheduler = install(tmp_path / "scheduler", ("kubectl",))
    environment = scheduler | {"PATH": f"{tmp_path / 'scheduler'}:{programs['PATH']}"}
    done = start("jobs/apply.sh --namespace=test", environment)
    assert done.returncode == 0, done.stderr
    check_run(place / "out/small", plain, capsys)


@pytest.fixture
def slurm(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A SLURM of one node, which the environment names."""
    with slurm_node(monkeypatch):
        yield


def wait_for_jobs(environment: dict[str, str], seconds: float = 240.0) -> None:
    """Wait until no job is left."""
    end = time.monotonic() + seconds
    while start("squeue --noheader", environment).stdout.strip():
        assert time.monotonic() < end, start("squeue; tail -n 5 */logs/*", environment).stdout
        time.sleep(0.5)


def submit(environment: dict[str, str]) -> None:
    done = start("'the jobs/submit.sh'", {**environment, "SLURM_CONF": os.environ["SLURM_CONF"]})
    assert done.returncode == 0, done.stderr


def test_slurm_gives_the_data_and_fits_of_one_machine(
    slurm: None, place: Path, plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--slices", "2", "--cpus", "1", "--run-folder", "out/a run", "-o", "the jobs", "-q"]
    assert run(app, ["emit", "recipe.yaml", "--to", "slurm", *words]) == 0
    environment = {**install_programs(tmp_path / "bin"), "SLURM_CONF": os.environ["SLURM_CONF"]}
    # First, without the configuration of one fit: its job fails, and the report is not begun.
    config = place / "the jobs" / "config" / "fit-baseline.yaml"
    config.rename(place / "elsewhere.yaml")
    submit(environment)
    wait_for_jobs(environment)
    (log,) = (place / "the jobs" / "logs").glob("fit-baseline-*.log")
    text = log.read_text()
    assert "no such file" in text
    assert "fit-baseline failed with exit code 3, see above. What is finished is kept; 'the jobs/sub" in text
    assert not list((place / "the jobs" / "logs").glob("report-*"))
    (place / "elsewhere.yaml").rename(config)
    submit(environment)
    wait_for_jobs(environment)
    check_run(place / "out/a run", plain, capsys)


@pytest.mark.slow
def test_slurm_runs_only_the_unfinished_slice_again(
    slurm: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits two minutes before it does."""
    monkeypatch.chdir(make_place(tmp_path))
    words: list[Any] = ["--slices", "3", "--cpus", "1", "--time-limit", "1h", "-o", "the jobs", "-q"]
    assert run(app, ["emit", "recipe.yaml", "--to", "slurm", *words]) == 0
    folder = tmp_path / "bin"
    environment = {**install(folder, PROGRAMS), "SLURM_CONF": os.environ["SLURM_CONF"]}
    fail(folder, "shards --slice 3/3", [4])
    submit(environment)
    wait_for_jobs(environment, 400.0)
    slices = [call["words"][-1] for call in calls(folder) if call["words"][-3].endswith("shards")]
    assert sorted(slices) == ["1/3", "2/3", "3/3", "3/3"]
    assert calls(folder)[-1]["words"][0] == "mbtf-pipeline"
