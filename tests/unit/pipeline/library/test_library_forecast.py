"""What a library is expected to take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbtf_pipeline.forecast import RunForecaster
from mbtf_pipeline.library.forecast import describe_library
from mbtf_pipeline.library.recipe import entries, load_library_recipe

# Fits of two minutes, the default, and two million paths besides those of the tests.
BASE = "base: {fit: {neumip: {}}, generate: {queries: {train: '1000000', spp: 2}}}"


def describe(folder: Path, names: str, options: str = "") -> str:
    file = folder / "library.yaml"
    file.write_text(f"name: test\nlibrary: [{names}]\n{options}{BASE}")
    library = load_library_recipe(file, [])
    return describe_library(library, entries(library, file))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in "abc":
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "height.npy", np.zeros((4, 4), np.float32))
    # Paths of 100 µs: they decide.
    monkeypatch.setattr(RunForecaster, "speed", property(lambda self: (0.0, 1e-4)))
    return tmp_path


def seconds(text: str) -> float:
    """Of "expected: about 1:02:03, ..."."""
    value = 0.0
    for part in text.removeprefix("expected: about ").partition(",")[0].split(":"):
        value = 60 * value + float(part)
    return value


def test_all_materials_and_stages_count(place: Path) -> None:
    one, two = describe(place, "a"), describe(place, "a, b")
    assert seconds(two) == pytest.approx(2 * seconds(one), abs=1)
    assert "training 2:00" in one
    assert "training 4:00" in two
    # One training time of all fits in place of their own, and the shared network on top.
    shared = describe(place, "a, b", "training: 10s\nshared_network: 30s\n")
    assert "training 0:10, shared network 0:30" in shared
    assert seconds(shared) == pytest.approx(seconds(two) - 240 + 10 + 30, abs=1)


def test_materials_that_cannot_be_used_are_left_out(place: Path) -> None:
    whole = describe(place, "b")
    (place / "a" / "height.npy").write_bytes(b"")
    found = describe(place, "a, b")
    assert found.startswith("expected: about ")
    assert seconds(found) <= 2 * seconds(whole) + 1
    assert describe(place, "a") == ""
