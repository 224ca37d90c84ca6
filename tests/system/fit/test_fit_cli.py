"""``mbtf-fit`` as a user runs it, also on measured data."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from support.commands import call, run_all
from support.fit_data import parallax, write_data
from support.measured_files import photographs, write_folder

QUICK = ("--steps", "5", "--batch", "500")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=3000, noise=0.01)


@pytest.fixture(scope="module")
def material(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fit") / "material"
    done = call(["mbtf-fit", str(shards), "-o", str(folder), *QUICK])
    assert done.code == 0, done.err
    # It ends with one suggestion.
    assert "steps are few" in done.out.splitlines()[-1]
    return folder


def test_all_commands_print_the_same_summary(shards: Path, material: Path) -> None:
    """Of the same numbers, which JSON holds in full; `evaluate` ends with the advice of the fit."""
    lines = {
        name: call(["mbtf-fit", name, *words]).out.splitlines()
        for name, words in (("evaluate", (str(material), str(shards))), ("info", (str(material),)))
    }
    assert lines["evaluate"][1:-1] == lines["info"][2:]
    assert "cosine 0.7-1" in call(["mbtf-fit", "info", str(material), "-v"]).out
    found = json.loads(call(["mbtf-fit", "evaluate", str(material), str(shards), "--json"]).out)
    again = json.loads(call(["mbtf-fit", str(shards), "-o", str(material), *QUICK, "--json"]).out)
    assert found["advice"] == again["advice"] == lines["evaluate"][-1]
    test = found["errors"]["test"]
    psnr = 10 * math.log10(2 ** (-2 * test["exposure"]) / test["mse"]["value"])
    assert test["psnr"]["value"] == pytest.approx(psnr)
    assert f"PSNR {psnr:.1f} dB at exposure {test['exposure']:+.2f} EV" in lines["info"][3]
    assert "train: 3000 queries in 2 shards" in call(["mbtf-fit", "info", str(shards)]).out
    assert json.loads(call(["mbtf-fit", "info", str(material), "--json"]).out)["weights"]


def test_a_finished_fit_is_not_trained_again(shards: Path, material: Path) -> None:
    before = (material / "material.json").read_bytes()
    done = call(["mbtf-fit", str(shards), "-o", str(material), *QUICK])
    assert done.code == 0, done.err
    assert done.err.splitlines() == [f"{material}: this fit is already finished; --overwrite trains it again"]
    assert (material / "material.json").read_bytes() == before
    done = call(["mbtf-fit", str(shards), "-o", str(material), *QUICK, "--overwrite"])
    assert "already finished" not in done.err


SMALL = "--size 64 --view 60,0 --light 60,0 --tiles-across 1"


def test_from_data_to_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_folder(tmp_path / "photographs", photographs())
    command = "import photographs --cosine included --scale 0.3183 --queries 20/texel -o felt"
    (done,) = run_all([command.split()], tmp_path)
    assert done.code == 0, done.err
    monkeypatch.chdir(tmp_path)
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
    drawn = call(["mbtf-fit", "preview", str(tmp_path / "material"), "-o", "pictures", *SMALL.split()])
    assert drawn.code == 0, drawn.err
    assert (tmp_path / "pictures/sheet.png").is_file()
