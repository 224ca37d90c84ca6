"""Fits to measured data, as a user runs them: they say what is unknown, and refuse what needs more."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.command_lines import call
from support.commands import run_all
from support.measured_files import photographs, zipped

SMALL = "--sheet-only --size 64 --spp 1 --view 60,0 --light 60,0 --tiles-across 1"


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("measured")
    (folder / "felt.zip").write_bytes(zipped(photographs()))
    command = "import felt.zip --cosine included --scale 0.3183 --queries 20/texel -o felt"
    (done,) = run_all([command.split()], folder)
    assert done.code == 0, done.err
    return folder


def test_from_data_to_pictures(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(work)
    fit = call(["mbtf-fit", "felt", "-o", "material", "--steps", "30", "--batch", "500", "--json"])
    assert fit.code == 0, fit.err
    assert "felt -> material: neumip+" in fit.err
    evaluated = call(["mbtf-fit", "evaluate", "material", "felt", "--json"])
    errors = json.loads(evaluated.out)["errors"]
    assert {"test", "held_out_queries", "training"} <= errors.keys()
    assert all(split["includes_noise"] for split in errors.values())
    for words in (["info", "material"], ["evaluate", "material", "felt", "--verbose"]):
        done = call(["mbtf-fit", *words])
        assert done.code == 0, done.err
        assert "these errors include the noise of the data" in done.out
    # Mitsuba looks for relative paths in the folder where it was first loaded.
    drawn = call(["mbtf-fit", "preview", str(work / "material"), "-o", "pictures", *SMALL.split()])
    assert drawn.code == 0, drawn.err
    assert (work / "pictures/sheet.png").is_file()
