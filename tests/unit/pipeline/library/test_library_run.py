"""What a library records while its materials run."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, Result
from mbtf_core.units import format_duration
from mbtf_fit.config import SHARED_PRESET
from mbtf_pipeline.library import run as library_run
from mbtf_pipeline.library.entries import entries, load_library_recipe
from mbtf_pipeline.library.run import LibraryResult, run_library

BASE = "library: [a, b]\nbase: {fit: {relief: {}}, generate: {queries: {train: 10/texel}}}\n"


class Runs(Runner):
    """In place of processes: records the calls, their arguments, and what the record says before each."""

    def __init__(self, out: Path) -> None:
        self.out, self.calls = out, [("", "")]
        self.arguments: dict[tuple[str, str], Any] = {}
        self.gpus: set[bool] = set()
        self.seen: list[dict[str, str]] = []
        self.errors: dict[str, str] = {}

    def map(self, function: Any, items: Iterable[Item], **options: Any) -> Iterator[Result]:  # type: ignore[override]
        assert options["independent"]
        for task in items:
            self.seen.append({m["name"]: m["state"] for m in self.record()["materials"]})
            self.calls.append((function.__name__, task.name))
            self.arguments[self.calls[-1]] = task.arguments
            self.gpus.add(task.gpu)
            error = self.errors.get(task.name, "")
            value = getattr(self, self.calls[-1][0])(task.arguments)
            yield Result(task.name, None if error else value, error)

    def run_material(self, arguments: Any) -> dict[str, Any]:
        return {"seconds": {"generate": 1.0}}

    def fit_shared(self, arguments: Any) -> list[dict[str, Any]]:
        return [{"value": 0.1 * k, "error": 0.01, "n": 9} for k in range(len(arguments["folders"]))]

    def record(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.out / "library.json").read_text())
        return found


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Runs:
    for name in "abc":
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "height.npy", np.zeros((4, 4), np.float32))
    found = Runs(tmp_path / "out")
    monkeypatch.setattr(library_run, "summarize", lambda folder: {"fits": {}, "reference": "none.png"})
    return found


def again(runs: Runs, options: str = "", base: str = BASE) -> LibraryResult:
    file = runs.out.parent / "library.yaml"
    file.write_text(f"name: test\n{options}{base}")
    library = load_library_recipe(file, [])
    runs.calls, runs.seen, runs.arguments = [("", "")], [], {}
    return run_library(library, entries(library, file), runs.out, command="", runner=runs)


def test_earlier_results_stay_until_their_run_ends(runs: Runs) -> None:
    again(runs)
    assert runs.seen == [{"a": "pending", "b": "pending"}, {"a": "done", "b": "pending"}]
    runs.errors = {"a": "no memory"}
    assert again(runs).failed == {"a": "no memory"}
    assert runs.seen == [{"a": "done", "b": "done"}, {"a": "failed", "b": "done"}]
    runs.errors = {}
    assert not again(runs).failed
    assert [m["error"] for m in runs.record()["materials"]] == ["", ""]


def test_the_others_go_on_after_a_failure(runs: Runs) -> None:
    runs.errors = {"a": "no memory"}
    assert again(runs).failed == runs.errors
    assert runs.calls[1:] == [("run_material", "a"), ("run_material", "b")]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_fits_on_a_gpu_take_one_of_their_worker(runs: Runs, device: str) -> None:
    options = "training: 10s\nshared_network: 5s\n"
    again(runs, options, BASE.replace("relief: {}", f"relief: {{device: {device}}}"))
    assert runs.gpus == {device == "cuda"}


def test_fits_of_a_material_share_its_time(runs: Runs) -> None:
    again(runs, "training: 3s\nmaterials: {a: {fit: {neumip: {}}}}\n")
    for name, expected in (("a", ["1.5s"] * 2), ("b", ["3s"])):
        fits = runs.arguments["run_material", name]["recipe"].fit
        assert [format_duration(fit.training.time) for fit in fits.values()] == expected


def test_a_shared_network_takes_two_fits_of_the_same_options(runs: Runs) -> None:
    other = "materials: {b: {fit: {relief: {seed: 3}}}}\n"
    # Fits that start from others share nothing.
    bases = [BASE.replace("relief: {}", f"relief: {{{kept}: m}}") for kept in ("decoder", "init_from")]
    for options, base in ((other, BASE), *(("", base) for base in bases)):
        done = again(runs, f"shared_network: 5s\n{options}", base)
        assert "fewer than two" in done.shared_error
        assert all(function != "fit_shared" for function, _ in runs.calls)
    assert not again(runs).shared_error


def test_the_most_fits_that_differ_in_time_alone_share_a_network(runs: Runs) -> None:
    # The name of a fit is no option.
    named = "c: {generate: {material: c}, fit: {relief: {seed: 3}, mine: {model: relief}}}"
    times = "a: {fit: {relief: {training: {time: 3s}}}}, b: {fit: {relief: {training: {steps: 7}}}}"
    again(runs, f"shared_network: 5s\nmaterials: {{{named}, {times}}}\n")
    found = runs.arguments["fit_shared", "shared network"]
    assert found["shards"] == [runs.out / "materials" / name / "shards" for name in "abc"]
    assert found["folders"] == [runs.out / "shared" / name for name in "abc"]
    training = found["config"].training
    assert (training.time, training.steps, training.shared_decoder) == (5.0, None, True)
    preset = SHARED_PRESET["training"]
    assert {key: training.model_dump(mode="json")[key] for key in preset} == preset
    errors = runs.record()["shared"]["errors"]
    assert {name: (error["fit"], error["value"]) for name, error in errors.items()} == {
        **{"a": ("relief", 0.0), "b": ("relief", 0.1), "c": ("mine", 0.2)}
    }


def test_failures_and_batches_of_shared_networks(runs: Runs) -> None:
    options = "shared_network: 5s\nmaterials: {c: c, a: {fit: {relief: {training: {batch: 32768}}}}}\n"
    runs.errors = {"c": "no memory"}
    again(runs, options)
    found = runs.arguments["fit_shared", "shared network"]
    assert [folder.name for folder in found["folders"]] == ["a", "b"]
    assert found["config"].training.batch == 32768
    runs.errors = {"shared network": "no memory"}
    assert again(runs, options).shared_error == "no memory"
