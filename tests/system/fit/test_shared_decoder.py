"""``--shared-decoder`` and ``--decoder`` as a user runs them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from support.command_lines import call, fails
from support.datasets import edit
from support.fit_data import constant, parallax, write_data

from mbtf_fit import FitResult, Material
from mbtf_fit.material.decoder import Decoder, network_tensors

QUICK = ("--steps", "6", "--batch", "300", "--device", "cpu")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    for seed, name in enumerate(("a", "b", "c")):
        write_data(folder / name, parallax, train=1000, test=100, seed=seed)
    return folder


@pytest.fixture(scope="module")
def materials(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fits") / "materials"
    narrow = ("--set", "network.width=16")
    words = ["--many", str(data / "a"), str(data / "b"), "--shared-decoder", "-o", str(out)]
    done = call(["mbtf-fit", *words, *QUICK, *narrow])
    assert done.code == 0, done.err
    assert "2 data sets -> " in done.err
    assert "relief with a shared network, training for 6 steps" in done.err
    lines = done.out.splitlines()
    assert [line.split()[0] for line in lines] == ["material", "a", "b"]
    assert all(re.search(r"\d\.\d{3} ± \d\.\d{3}", line) for line in lines[1:])
    return out


def test_a_fit_takes_model_and_network_from_the_folder(materials: Path, data: Path, tmp_path: Path) -> None:
    wanted = Decoder.find(materials).tensors()
    for folder in (materials / "decoder", materials / "a"):
        tensors = Decoder.find(folder).tensors()
        assert all((tensors[name] == wanted[name]).all() for name in wanted)
    # A preset has another network.
    words = ["--decoder", str(materials), "-o", str(tmp_path / "m"), "--quality", "draft", *QUICK]
    done = call(["mbtf-fit", str(data / "c"), *words])
    assert done.code == 0, done.err
    found = Material.load(tmp_path / "m")
    assert found.config.network.width == 16
    own = network_tensors(found.model)
    assert all((own[name] == wanted[name]).all() for name in wanted)


def test_the_same_command_keeps_a_finished_fit(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["--many", str(data), "--shared-decoder", "-o", str(tmp_path / "m"), *QUICK]
    first = call(["mbtf-fit", *words, "--json"])
    assert first.code == 0, first.err
    found = json.loads(first.out)
    assert Path(found["decoder"]["folder"]) == tmp_path / "m" / "decoder"
    assert [fit["result"]["resumed"] for fit in found["fits"]] == [False] * 3
    again = json.loads(call(["mbtf-fit", *words, "--json"]).out)
    assert again["decoder"] == found["decoder"]
    assert [fit["result"]["resumed"] for fit in again["fits"]] == [True] * 3
    # As a single fit, each material says if it returned to an earlier state.
    monkeypatch.setattr(FitResult, "kept_step", 6)
    said = call(["mbtf-fit", *words]).out
    assert re.findall(r"^(\w): validation error rose from .* kept the state after 6 steps$", said, re.M) == [
        *"abc"
    ]
    other = fails(3, *words, "--seed", "1")
    assert "holds a fit of another configuration: seed" in other


def test_data_without_geometry_share_a_network_of_neumip(data: Path, tmp_path: Path) -> None:
    flat = write_data(tmp_path / "flat", constant(0.3), train=500, test=50)
    edit(flat / "manifest.json", lambda manifest: manifest.update(geometry=None))
    words = ["--many", str(data / "a"), str(flat), "--shared-decoder", "-o", str(tmp_path / "m"), *QUICK]
    done = call(["mbtf-fit", *words])
    assert done.code == 0, done.err
    assert Material.load(tmp_path / "m" / "flat").config.model == "neumip"


def test_command_lines_that_cannot_share_a_network(materials: Path, data: Path, tmp_path: Path) -> None:
    a, out = str(data / "a"), ("-o", str(tmp_path / "m"), *QUICK)
    for more in ((), ("--decoder", str(materials))):
        assert "--shared-decoder requires --many" in fails(2, a, "--shared-decoder", *more, *out)
    words = ("--many", str(data), "--shared-decoder")
    assert "leave out --processes" in fails(2, *words, "--processes", "2", *out)
    # The models that share networks, and the option that contradicts it, are a matter of usage; data are not.
    assert "which neumip and relief have" in fails(2, *words, "--model", "neumip+", *out)
    assert "leave out shared_decoder" in fails(2, *words, "--decoder", str(materials), *out)
    assert "takes two data sets at least" in fails(3, "--many", a, "--shared-decoder", *out)
    clash = write_data(tmp_path / "decoder", parallax, train=500, test=50)
    assert "rename the data set of this name" in fails(3, "--many", str(clash), *words[1:], *out)
    assert "no such folder" in fails(3, "--many", str(tmp_path / "none"), *words[1:], *out)
    assert not (tmp_path / "m").exists()


def test_folders_without_a_network_are_refused(materials: Path, data: Path, tmp_path: Path) -> None:
    c, out = str(data / "c"), ("-o", str(tmp_path / "m"), *QUICK)
    assert "nowhere: no such folder" in fails(3, c, "--decoder", str(tmp_path / "nowhere"), *out)
    assert "holds neither a shared network nor a material" in fails(3, c, "--decoder", str(data), *out)
    done = call(["mbtf-fit", c, "--model", "neumip-baseline", "-o", str(tmp_path / "baseline"), *QUICK])
    assert done.code == 0, done.err
    assert not (tmp_path / "m").exists()
    message = fails(3, c, "--decoder", str(tmp_path / "baseline"), *out)
    assert "has the network of neumip-baseline; only those of relief and neumip are shared" in message


@pytest.mark.parametrize("name", ["weights.safetensors", "decoder.json"])
def test_corrupt_networks_are_refused(materials: Path, data: Path, tmp_path: Path, name: str) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    for path in (materials / "decoder").iterdir():
        (broken / path.name).write_bytes(path.read_bytes())
    # Those of a material hold the same network.
    (broken / "weights.safetensors").write_bytes((materials / "a" / "weights.safetensors").read_bytes())
    message = fails(3, str(data / "c"), "--decoder", str(broken), "-o", str(tmp_path / "m"), *QUICK)
    assert "is damaged, or of another material" in message
    (broken / "weights.safetensors").write_bytes((materials / "decoder/weights.safetensors").read_bytes())
    whole = (broken / name).read_bytes()
    (broken / name).write_bytes(whole[: len(whole) // 2])
    message = fails(3, str(data / "c"), "--decoder", str(broken), "-o", str(tmp_path / "m"), *QUICK)
    assert str(broken / name) in message
    (broken / name).unlink()
    fails(3, str(data / "c"), "--decoder", str(broken), "-o", str(tmp_path / "m"), *QUICK)
