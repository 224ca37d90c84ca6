"""``repair`` restores what ``verify`` finds missing or corrupt, and nothing else."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.datasets import edit, flip
from support.small_runs import command, contents, generate, noisy_plane

from mbtf_core.app.console import run
from mbtf_core.data.verify import verify
from mbtf_core.errors import InputError
from mbtf_fit.cli.app import app as fit_app
from mbtf_gen.cli.app import app
from mbtf_gen.generation import repair as repairs
from mbtf_gen.generation.repair import repair
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import RunPlan, reference_plan
from mbtf_gen.planning.simulation import ClosedForm


@pytest.fixture(autouse=True)
def fast_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ClosedForm, "estimate", noisy_plane)
    monkeypatch.setattr(os, "fsync", lambda handle: None)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A data set of three training shards and a test shard, and beside it another copy, `whole`."""
    assert generate(command(tmp_path, tmp_path / "out")) == 0
    shutil.copytree(tmp_path / "out", tmp_path / "whole")
    return tmp_path / "out"


def moments(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def replace_by_another(out: Path) -> None:
    """Shard 1 is a copy of shard 0 under its own name."""
    for suffix in (".npz", ".json"):
        shutil.copy(out / f"train-00000{suffix}", out / f"train-00001{suffix}")
    edit(out / "train-00001.json", lambda record: record.update(file="train-00001.npz", index=1))


CORRUPTIONS: dict[str, tuple[Callable[[Path], object], set[str], set[str]]] = {
    "nothing": (lambda out: None, set(), set()),
    "byte": (lambda out: flip(out / "train-00002.npz", 2000), {"train-00002.npz"}, set()),
    "shard gone": (lambda out: (out / "train-00000.npz").unlink(), {"train-00000.npz"}, set()),
    "sidecar": (lambda out: flip(out / "train-00001.json", 500), {"train-00001.npz"}, set()),
    "copy": (replace_by_another, {"train-00000.npz", "train-00001.npz"}, set()),
    "configuration": (lambda out: flip(out / "config.yaml", 30), set(), {"config.yaml"}),
    "manifest and geometry": (
        lambda out: (flip(out / "manifest.json", 90), flip(out / "geometry.exr", 2000)),
        set(),
        {"manifest.json", "geometry.exr"},
    ),
    "manifest gone": (lambda out: (out / "manifest.json").unlink(), set(), {"manifest.json"}),
    "no JSON, and a shard": (
        lambda out: ((out / "manifest.json").write_text("{"), flip(out / "train-00000.npz", 700)),
        {"train-00000.npz"},
        {"manifest.json"},
    ),
}


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_faulty_files_are_restored_and_nothing_else(name: str, out: Path) -> None:
    corrupt, shards, documents = CORRUPTIONS[name]
    corrupt(out)
    before = moments(out)
    done = repair(out)
    assert (set(done.shards), set(done.documents), done.complete) == (shards, documents, True)
    assert contents(out) == contents(out.parent / "whole")
    assert verify(out) == []
    touched = shards | {Path(s).with_suffix(".json").name for s in shards} | documents | {"manifest.json"}
    kept = set(before) - touched
    assert {f: t for f, t in moments(out).items() if f in kept} == {f: before[f] for f in kept}
    # A second repair finds nothing and writes nothing.
    before = moments(out)
    assert repair(out).faults == []
    assert moments(out) == before


@pytest.fixture
def other(out: Path) -> Path:
    """The same of another seed."""
    line = command(out.parent, out.parent / "other")
    assert generate([*line, "--seed", "1"]) == 0
    return out.parent / "other"


@pytest.mark.parametrize(
    "files", [("manifest.json",), ("manifest.json", "config.yaml"), ("train-00001.npz", "train-00001.json")]
)
def test_files_that_disagree_are_named_and_not_touched(
    files: tuple[str, ...], out: Path, other: Path
) -> None:
    for name in files:
        shutil.copy(other / name, out)
    before = moments(out)
    with pytest.raises(InputError, match="belong to another configuration or material") as caught:
        repair(out)
    assert ("train-00001.json" if files[0].startswith("train") else "train-00000.json") in caught.value.what
    assert moments(out) == before
    if "config.yaml" not in files:
        for name in files:
            (out / name).unlink()
        assert repair(out).complete
        assert contents(out) == contents(out.parent / "whole")


def test_a_lost_manifest_is_answered_everywhere(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (out / "manifest.json").unlink()
    before = contents_of_shards(out)
    again = command(out.parent, out)
    lines = [again, [*again, "--overwrite"], ["verify", str(out)], ["merge", str(out)]]
    fits = [[str(out), "--time", "1s", "-o", str(out.parent / "material")], ["info", str(out)]]
    for program, line in [*((app, line) for line in lines), *((fit_app, line) for line in fits)]:
        capsys.readouterr()
        assert run(program, line) == 3, line
        assert f"repair it with: mbtf-gen repair {out}" in capsys.readouterr().err, line
    assert contents_of_shards(out) == before


def contents_of_shards(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.glob("t*-*")}


def test_another_material_is_refused_untouched(out: Path) -> None:
    flip(out / "train-00000.npz", 700)
    np.save(out.parent / "plane.npy", np.full((4, 8), 0.25))
    before = contents(out)
    with pytest.raises(InputError, match=r"since the data set was generated \(height: [0-9a-f]{8}… -> "):
        repair(out)
    assert contents(out) == before


def test_a_material_that_has_moved_is_named(out: Path) -> None:
    flip(out / "train-00000.npz", 700)
    moved = out.parent / "moved.npy"
    (out.parent / "plane.npy").rename(moved)
    with pytest.raises(InputError, match="the material is not at") as caught:
        repair(out)
    assert "--material" in caught.value.hint
    assert repair(out, material=str(moved)).complete
    assert contents(out) == contents(out.parent / "whole")


def test_a_manifest_is_not_restored_without_its_plan(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (out / "manifest.json").unlink()
    before = moments(out)

    def other_plan(job: Job) -> RunPlan:
        config = job.config.model_copy(
            update={"effects": job.config.effects.model_copy(update={"mode": "all"})}
        )
        return RunPlan(reference_plan(Job.of(config, job.material)))

    with monkeypatch.context() as patch:
        patch.setattr(repairs, "plan_run", other_plan)
        with pytest.raises(InputError, match="no intact sidecar states the plan"):
            repair(out)
    for sidecar in out.glob("t*.json"):
        flip(sidecar, 200)
    before = moments(out)
    with pytest.raises(InputError, match="no intact sidecar"):
        repair(out)
    assert moments(out) == before


def test_another_manifest_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text('{"name": "a web page"}')
    with pytest.raises(InputError):
        repair(tmp_path)
    assert (tmp_path / "manifest.json").read_text() == '{"name": "a web page"}'
