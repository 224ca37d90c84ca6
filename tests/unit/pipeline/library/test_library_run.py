"""What a library records while its materials run."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.cluster.task import Task, TaskResult
from mbtf_pipeline.library import run as library_run
from mbtf_pipeline.library.recipe import entries, load_library_recipe
from mbtf_pipeline.library.run import LibraryResult, run_library

BASE = "library: [a, b]\nbase: {fit: {relief: {}}, generate: {queries: {train: 10/texel}}}\n"


class Runs:
    """In place of processes: records the calls, and what the record says before each."""

    def __init__(self, out: Path) -> None:
        self.out, self.calls = out, [("", "")]
        self.seen: list[dict[str, str]] = []
        self.interrupted_at = 0
        self.errors: dict[str, str] = {}

    def __call__(self, tasks: Iterable[Task]) -> Iterator[TaskResult]:
        for task in tasks:
            self.seen.append({m["name"]: m["state"] for m in self.record()["materials"]})
            self.calls.append((task.function.rpartition(":")[2], task.name))
            if len(self.calls) - 1 == self.interrupted_at:
                raise KeyboardInterrupt
            error = self.errors.get(task.name, "")
            value: Any = 0.1 if self.calls[-1][0] == "first_fit" else {"seconds": {"generate": 1.0}}
            yield TaskResult(task, None if error else value, error)

    def record(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.out / "library.json").read_text())
        return found


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runs:
    for name in "ab":
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "height.npy", np.zeros((4, 4), np.float32))
    found = Runs(tmp_path / "out")
    monkeypatch.setattr(library_run, "run_in_children", found)
    monkeypatch.setattr(library_run, "summarize", lambda folder: {"fits": {}, "reference": "none.png"})
    return found


def again(runs: Runs, options: str = "") -> LibraryResult:
    file = runs.out.parent / "library.yaml"
    file.write_text(f"name: test\n{options}{BASE}")
    library = load_library_recipe(file, [])
    runs.calls, runs.seen = [("", "")], []
    return run_library(library, entries(library, file), runs.out, command="")


def test_earlier_results_stay_until_their_run_ends(runs: Runs) -> None:
    again(runs)
    assert runs.seen == [{"a": "pending", "b": "pending"}, {"a": "done", "b": "pending"}]
    runs.errors = {"a": "no memory"}
    assert again(runs).failed == {"a": "no memory"}
    assert runs.seen == [{"a": "done", "b": "done"}, {"a": "failed", "b": "done"}]
    runs.errors = {}
    assert not again(runs).failed
    assert [m["error"] for m in runs.record()["materials"]] == ["", ""]


def test_each_first_fit_is_recorded_as_it_comes(runs: Runs) -> None:
    runs.interrupted_at = 2
    with pytest.raises(KeyboardInterrupt):
        again(runs, "training: 10s\n")
    assert set(runs.record()["division"]["errors"]) == {"a"}
    runs.interrupted_at = 0
    again(runs, "training: 10s\n")
    assert runs.calls[1:] == [("first_fit", "b"), ("run_material", "a"), ("run_material", "b")]


def test_paths_are_relative_to_the_page(runs: Runs) -> None:
    again(runs)
    assert [m["path"] for m in runs.record()["materials"]] == ["../a", "../b"]


def test_a_shared_network_takes_two_fits_of_the_same_options(runs: Runs) -> None:
    other = "materials: {b: {fit: {relief: {seed: 3}}}}\n"
    done = again(runs, f"shared_network: 5s\n{other}")
    assert "fewer than two" in done.shared_error
    assert all(function != "fit_shared" for function, _ in runs.calls)
    assert not again(runs).shared_error
