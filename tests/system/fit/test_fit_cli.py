"""``mbtf-fit`` as a user runs it."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import RunPython
from support.command_lines import call, fails
from support.datasets import edit
from support.fit_data import parallax, write_data

QUICK = ("--steps", "5", "--batch", "500")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=3000, noise=0.01)


@pytest.fixture(scope="module")
def material(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fit") / "material"
    command = [sys.executable, "-m", "mbtf_fit", str(shards), "-o", str(folder), *QUICK]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "training for 5 steps (change it with --time or --steps)" in done.stderr
    assert len(done.stdout.splitlines()) <= 5
    assert re.search(r"^unexplained variance [\d.]+ ± [\d.]+ of \d+ test queries", done.stdout, re.M)
    return folder


def test_export_writes_the_reported_files(material: Path, tmp_path: Path, run_python: RunPython) -> None:
    out = tmp_path / "export"
    done = run_python("-m", "mbtf_fit", "export", str(material), "--half", "-o", str(out), "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["files"] == {p.name: p.stat().st_size for p in out.iterdir() if p.name != "export.json"}
    assert set(found["files"]) == {"textures.exr", "layers.json"}
    assert 0 < found["half"]["relative"] < 0.01
    again = tmp_path / "half"
    done = run_python(
        "-m", "mbtf_fit", "export", str(material), "--to", "material", "--half", "-o", str(again)
    )
    assert done.returncode == 0, done.stderr
    assert "half precision: rms error" in done.stdout
    done = run_python("-m", "mbtf_fit", "info", str(again))
    deviation = re.search(r"largest deviation (\S+)", done.stdout)
    assert deviation is not None
    # Between the values of PyTorch, which are stored, and those of whatever evaluates here.
    assert float(deviation[1]) < 1e-6
    message = fails(3, "export", str(material), "--to", "material")
    assert "choose another folder with -o" in message


def test_json_is_one_object(shards: Path, tmp_path: Path, run_python: RunPython) -> None:
    done = run_python("-m", "mbtf_fit", str(shards), "-o", str(tmp_path / "m"), *QUICK, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["training"]["steps"] == 5
    assert set(found["errors"]) == {"test", "held_out_queries", "held_out_directions", "training"}


def test_all_commands_print_the_same_summary(shards: Path, material: Path, run_python: RunPython) -> None:
    """Of the same numbers, which JSON holds in full."""
    lines = {}
    for name, words in (("evaluate", (str(material), str(shards))), ("info", (str(material),))):
        lines[name] = run_python("-m", "mbtf_fit", name, *words).stdout.splitlines()
        # Five steps are too few, which is said, too.
        assert len([line for line in lines[name] if not line.startswith("above 1")]) <= 5, lines[name]
        table = run_python("-m", "mbtf_fit", name, *words, "-v").stdout
        assert "cosine 0.7-1" in table
        assert table.splitlines()[: len(lines[name])] == lines[name]
    assert lines["evaluate"][1:] == lines["info"][2:]
    found = json.loads(run_python("-m", "mbtf_fit", "evaluate", str(material), str(shards), "--json").stdout)
    test = found["errors"]["test"]
    psnr = 10 * math.log10(2 ** (-2 * test["exposure"]) / test["mse"]["value"])
    assert test["psnr"]["value"] == pytest.approx(psnr)
    assert f"PSNR {psnr:.1f} dB at exposure {test['exposure']:+.2f} EV" in lines["info"][3]
    assert lines["info"][3].endswith(f": {test['visibility']} beside the reference")
    assert {errors["exposure"] for errors in found["errors"].values()} == {test["exposure"]}


def test_a_finished_fit_is_not_trained_again(shards: Path, material: Path, run_python: RunPython) -> None:
    before = (material / "material.json").read_bytes()
    done = run_python("-m", "mbtf_fit", str(shards), "-o", str(material), *QUICK)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines() == [
        f"{material}: this fit is already finished; --overwrite trains it again"
    ]
    assert "gradients reached every texel" not in done.stdout
    told = run_python("-m", "mbtf_fit", str(shards), "-o", str(material), *QUICK, "--verbose")
    assert "gradients reached every texel" in told.stdout
    assert "unexplained variance  test" in told.stdout
    assert (material / "material.json").read_bytes() == before
    done = run_python("-m", "mbtf_fit", str(shards), "-o", str(material), *QUICK, "--overwrite")
    assert "training for 5 steps" in done.stderr
    assert "already finished" not in done.stderr


def test_data_of_another_material_cause_a_warning(tmp_path: Path, run_python: RunPython) -> None:
    made = {}
    for name, digest in (("own", "1"), ("other", "2")):
        made[name] = write_data(tmp_path / name, parallax, train=2000, test=500)
        inputs = {"height": digest, "settings": "same"}
        edit(made[name] / "manifest.json", lambda manifest, inputs=inputs: manifest.update(inputs=inputs))
    fitted = tmp_path / "fitted"
    done = run_python("-m", "mbtf_fit", str(made["own"]), "-o", str(fitted), *QUICK)
    assert done.returncode == 0, done.stderr
    for name, foreign in (("own", []), ("other", ["height"])):
        done = run_python("-m", "mbtf_fit", "evaluate", str(fitted), str(made[name]), "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["foreign_inputs"] == foreign
        assert ("made from another material" in done.stderr) == bool(foreign)
        assert ("(height differs)" in done.stderr) == bool(foreign)


def test_evaluate_and_info_report_text_and_json(shards: Path, material: Path) -> None:
    for words, texts in (
        (
            ["evaluate", str(material), str(shards), "--verbose"],
            ("held-out directions", "training queries", "level 3", "cosine 0.7-1"),
        ),
        (["info", str(material)], ("2233 network weights", "conformance: 256 queries")),
        (["info", str(shards)], ("train: 3000 queries in 2 shards",)),
    ):
        done = call(["mbtf-fit", *words])
        assert all(text in done.out for text in texts), done
        done = call(["mbtf-fit", *words, "--json"])
        assert done.code == 0, done.err
        json.loads(done.out)


def test_bad_input_exits_with_3_and_a_hint(shards: Path, material: Path, tmp_path: Path) -> None:
    out = ["-o", str(tmp_path / "m")]
    assert "no such folder" in fails(3, str(tmp_path / "none"), *out)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "mbtf-gen" in fails(3, str(empty), *out)
    other = write_data(tmp_path / "schema", parallax, train=10, schema=99)
    assert "schema version 99" in fails(3, str(other), *out)
    image = write_data(tmp_path / "image", parallax, train=10, layout="image")
    assert "--layout shuffled" in fails(3, str(image), *out)
    assert "training.batch: 500 -> 700" in fails(
        3, str(shards), "-o", str(material), "--steps", "5", "--batch", "700"
    )
    assert "no such folder" in fails(3, "info", str(tmp_path / "none"))
    assert "no material.json" in fails(3, "evaluate", str(empty), str(shards))
