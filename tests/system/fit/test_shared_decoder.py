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
from mbtf_fit.material.decoder import network_tensors

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
    wanted = network_tensors(Material.load(materials / "a").model)
    # A preset has another network.
    words = ["--decoder", str(materials / "a"), "-o", str(tmp_path / "m"), "--quality", "draft", *QUICK]
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
    assert [fit["result"]["resumed"] for fit in found["fits"]] == [False] * 3
    again = json.loads(call(["mbtf-fit", *words, "--json"]).out)
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
