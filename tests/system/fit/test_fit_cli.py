"""``mbtf-fit`` as a user runs it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from support.command_lines import call
from support.fit_data import parallax, write_data

QUICK = ("--steps", "5", "--batch", "500")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=3000, noise=0.01)


@pytest.fixture(scope="module")
def material(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fit") / "material"
    done = call(["mbtf-fit", str(shards), "-o", str(folder), *QUICK])
    assert done.code == 0, done.err
    # One suggestion, and its command.
    *_, reason, command = done.out.splitlines()
    assert reason.endswith(":")
    assert command.startswith("  mbtf-")
    return folder


def test_all_commands_print_the_same_summary(shards: Path, material: Path) -> None:
    """Of the same numbers, which JSON holds in full; `evaluate` ends with the next command, as a fit does."""
    lines = {
        name: call(["mbtf-fit", name, *words]).out.splitlines()
        for name, words in (("evaluate", (str(material), str(shards))), ("info", (str(material),)))
    }
    advice = lines["evaluate"][-2:]
    assert lines["evaluate"][1:-2] == lines["info"][2:]
    assert "cosine 0.7-1" in call(["mbtf-fit", "info", str(material), "-v"]).out
    found = json.loads(call(["mbtf-fit", "evaluate", str(material), str(shards), "--json"]).out)
    again = json.loads(call(["mbtf-fit", str(shards), "-o", str(material), *QUICK, "--json"]).out)
    assert found["next_command"] == again["next_command"] == advice[1].strip()
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
