"""Measured BTFs from file to material, and back: the programs as a user runs them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import Done, run_named
from support.measured_files import btf, photographs, write_folder, zipped

from mbtf_core.data.dataset import Dataset

SMALL = "--height-scale 0.05 --resolution 8 --spp 4 --test-queries 64 --test-spp 16"
LINES = {
    "import": "import felt.btf --queries 300 --test-queries 20 --min-cos 0.2 -o felt --json",
    "again": "import felt.btf --queries 300 --test-queries 20 --min-cos 0.2 -o felt --json",
    "verify": "verify felt",
    "zip": "import photographs.zip --cosine excluded --queries 300 -o photographs",
    "folder": "import folder --cosine excluded --queries 300 -o photographs_of_folder",
    "generate": f"wool {SMALL} --queries 20/texel -o shuffled",
    "slices": f"wool {SMALL} --queries 81/texel --layout slices -o slices",
    "to neumip": "export shuffled shuffled.hdf5",
    "from neumip": "import shuffled.hdf5 --test-queries 32 -o neumip",
    "to neuralbtf": "export slices slices.hdf5 --program neuralbtf",
    "from neuralbtf": "import slices.hdf5 --cosine excluded --queries 60/texel -o neuralbtf",
    "wrong layout": "export shuffled other.hdf5 --program neuralbtf",
    "exists": "export shuffled shuffled.hdf5",
}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("measured")
    (folder / "felt.btf").write_bytes(btf())
    (folder / "photographs.zip").write_bytes(zipped(photographs()))
    write_folder(folder / "folder", photographs())
    (folder / "wool").mkdir()
    heights = np.random.default_rng(0).random((8, 8)).astype(np.float32)
    np.save(folder / "wool/height.npy", heights)
    (folder / "wool/material.yaml").write_text("height: height.npy\nbase_color: [0.8, 0.5, 0.2]\n")
    return folder


@pytest.fixture(scope="module")
def done(work: Path) -> dict[str, Done]:
    return run_named(LINES, work)


def test_an_import_is_a_data_set(work: Path, done: dict[str, Done]) -> None:
    assert done["import"].result()["splits"] == {"train": 160, "test": 20}
    assert done["again"].code == done["verify"].code == 0
    assert Dataset.open(work / "felt").load("train")["value_a"].min() > 0
    for name in ("zip", "folder"):
        assert done[name].code == 0, done[name].err


@pytest.mark.parametrize("name", ["wrong layout", "exists"])
def test_what_cannot_be_used_is_refused_in_one_line(done: dict[str, Done], name: str) -> None:
    assert done[name].code != 0
    (line,) = [line for line in done[name].err.splitlines() if line.startswith("error:")]
    assert "internal" not in line


def rows(arrays: dict[str, Any], digits: int = 4) -> dict[tuple[Any, ...], Any]:
    """Values by position and directions, rounded."""
    keys = np.concatenate(
        [arrays[n].reshape(-1, w) for n, w in (("u", 2), ("omega_i", 3), ("omega_o", 3))], 1
    )
    values = arrays.get("value_b", arrays["value_a"]) * np.float32(0.5) + arrays["value_a"] * np.float32(0.5)
    return dict(zip(map(tuple, np.round(keys, digits).tolist()), values.reshape(-1, 3).tolist(), strict=True))


@pytest.mark.parametrize(("source", "name"), [("shuffled", "neumip"), ("slices", "neuralbtf")])
def test_an_export_is_imported_exactly(work: Path, done: dict[str, Done], source: str, name: str) -> None:
    assert done[f"from {name}"].code == 0, done[f"from {name}"].err + done[f"to {name}"].err
    before = rows(Dataset.open(work / source).load("train"))
    data = Dataset.open(work / name)
    after = {key: value for split in data.splits for key, value in rows(data.load(split)).items()}
    assert len(after) > 500
    missing = [key for key in after if key not in before]
    assert len(missing) < 0.01 * len(after)
    assert all(before[key] == value for key, value in after.items() if key in before)
    assert data.lattice.finest == 3
