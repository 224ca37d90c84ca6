"""``mbtf-fit`` as a user runs it."""

from __future__ import annotations

import json
import math
import re
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
    assert "training for 5 steps (change it with --time or --steps); reading, calibration and" in done.err
    # 5 s, or longer where other work leaves less of the processors.
    assert re.search(r" errors take about \d+ s beside it", done.err)
    # One suggestion, and its command.
    *summary, reason, command = done.out.splitlines()
    assert len(summary) <= 5
    assert reason.endswith(":")
    assert command.startswith("  mbtf-")
    assert re.search(r"^unexplained variance [\d.]+ ± [\d.]+ of \d+ test queries", done.out, re.M)
    return folder


def test_all_commands_print_the_same_summary(shards: Path, material: Path) -> None:
    """Of the same numbers, which JSON holds in full; `evaluate` ends with the next command, as a fit does."""
    lines, advice = {}, []
    for name, words in (("evaluate", (str(material), str(shards))), ("info", (str(material),))):
        lines[name] = call(["mbtf-fit", name, *words]).out.splitlines()
        if name == "evaluate":
            lines[name], advice = lines[name][:-2], lines[name][-2:]
        # Five steps are too few, which is said, too.
        assert len([line for line in lines[name] if not line.startswith("above 1")]) <= 5, lines[name]
        table = call(["mbtf-fit", name, *words, "-v"]).out
        assert "cosine 0.7-1" in table
        assert table.splitlines()[: len(lines[name])] == lines[name]
    assert lines["evaluate"][1:] == lines["info"][2:]
    found = json.loads(call(["mbtf-fit", "evaluate", str(material), str(shards), "--json"]).out)
    again = json.loads(call(["mbtf-fit", str(shards), "-o", str(material), *QUICK, "--json"]).out)
    assert found["next_command"] == again["next_command"] == advice[1].strip()
    assert advice[1].strip().startswith("mbtf-")
    test = found["errors"]["test"]
    psnr = 10 * math.log10(2 ** (-2 * test["exposure"]) / test["mse"]["value"])
    assert test["psnr"]["value"] == pytest.approx(psnr)
    assert f"PSNR {psnr:.1f} dB at exposure {test['exposure']:+.2f} EV" in lines["info"][3]
    assert lines["info"][3].endswith(f": {test['visibility']} beside the reference")
    assert {errors["exposure"] for errors in found["errors"].values()} == {test["exposure"]}
    assert "train: 3000 queries in 2 shards" in call(["mbtf-fit", "info", str(shards)]).out
    assert json.loads(call(["mbtf-fit", "info", str(material), "--json"]).out)["weights"]


def test_a_finished_fit_is_not_trained_again(shards: Path, material: Path) -> None:
    before = (material / "material.json").read_bytes()
    done = call(["mbtf-fit", str(shards), "-o", str(material), *QUICK])
    assert done.code == 0, done.err
    assert done.err.splitlines() == [f"{material}: this fit is already finished; --overwrite trains it again"]
    told = call(["mbtf-fit", str(shards), "-o", str(material), *QUICK, "--verbose"])
    assert "unexplained variance  test" in told.out
    assert (material / "material.json").read_bytes() == before
    done = call(["mbtf-fit", str(shards), "-o", str(material), *QUICK, "--overwrite"])
    assert "training for 5 steps" in done.err
    assert "already finished" not in done.err
