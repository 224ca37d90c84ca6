"""What a library records while its materials run, and its page."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, Result
from mbtf_pipeline.collection.recipes import Collection, load
from mbtf_pipeline.collection.run import CollectionResult, run_collection

BASE = "library: [a, b]\nbase: {fit: {relief: {}}, generate: {queries: {train: 10/texel}}}\n"
DONE = {"seconds": {"generate": 1.0}, "fits": {}, "reference": "none.png"}


class Runs(Runner):
    """In place of processes: records the items, and what the record says before each."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.items: dict[str, Item] = {}
        self.seen: list[dict[str, str]] = []
        self.errors: dict[str, str] = {}

    def map(self, function: Any, items: Iterable[Item], **options: Any) -> Iterator[Result]:  # type: ignore[override]
        assert options["independent"]
        for item in items:
            self.seen.append({m["name"]: m["state"] for m in self.record()["runs"]})
            self.items[item.name] = item
            error = self.errors.get(item.name, "")
            yield Result(item.name, None if error else DONE, error)

    def record(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads((self.out / "collection.json").read_text())
        return found


@pytest.fixture
def runs(tmp_path: Path) -> Runs:
    for name in "ab":
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "height.npy", np.zeros((4, 4), np.float32))
    return Runs(tmp_path / "out")


def again(runs: Runs, options: str = "", base: str = BASE) -> CollectionResult:
    file = runs.out.parent / "library.yaml"
    file.write_text(f"name: test\n{options}{base}")
    library = load(file)
    assert isinstance(library, Collection)
    runs.items, runs.seen = {}, []
    return run_collection(library, file, runs.out, command="", runner=runs)


def test_earlier_results_stay_until_their_run_ends(runs: Runs) -> None:
    again(runs)
    assert runs.seen == [{"a": "pending", "b": "pending"}, {"a": "done", "b": "pending"}]
    # The others go on after a failure.
    runs.errors = {"a": "no memory"}
    assert again(runs).names("failed") == ["a"]
    assert runs.seen == [{"a": "done", "b": "done"}, {"a": "failed", "b": "done"}]
    runs.errors = {}
    assert not again(runs).names("failed")
    assert [m["error"] for m in runs.record()["runs"]] == ["", ""]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_fits_on_a_gpu_take_one_of_their_worker(runs: Runs, device: str) -> None:
    again(runs, base=BASE.replace("relief: {}", f"relief: {{device: {device}}}"))
    assert {item.gpu for item in runs.items.values()} == {device == "cuda"}


def test_fits_of_a_material_share_its_time(runs: Runs) -> None:
    again(runs, "training: 3s\nmaterials: {a: {fit: {neumip: {}}}}\n")
    for name, expected in (("a", ["1.5s"] * 2), ("b", ["3s"])):
        fits = runs.items[name].arguments["recipe"].fit
        assert [str(fit.training.time) for fit in fits.values()] == expected
