"""Measured BTFs from file to data set: the programs as a user runs them."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.commands import Done, run_named
from support.measured_files import btf, photographs, write_folder, zipped

from mbtf_core.data.dataset import Dataset

LINES = {
    "import": "import felt.btf --queries 300 --test-queries 20 --min-cos 0.2 -o felt --json",
    "again": "import felt.btf --queries 300 --test-queries 20 --min-cos 0.2 -o felt --json",
    "verify": "verify felt",
    "zip": "import photographs.zip --cosine excluded --queries 300 -o photographs",
    "folder": "import folder --cosine excluded --queries 300 -o photographs_of_folder",
}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("measured")
    (folder / "felt.btf").write_bytes(btf())
    (folder / "photographs.zip").write_bytes(zipped(photographs()))
    write_folder(folder / "folder", photographs())
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
