"""``mbtf-fit --many``: several data sets, none stopped by another's failure, also with a shared network."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.commands import call
from support.datasets import edit
from support.fit_data import constant, parallax, write_data

from mbtf_core.data.shard_files import read_shard, write_shard
from mbtf_core.errors import InputError
from mbtf_fit import Material
from mbtf_fit.material.decoder import network_tensors
from mbtf_fit.training.fit_many import find_data

QUICK = ("--steps", "6", "--batch", "300", "--device", "cpu")


def test_one_that_fails_does_not_stop_the_others(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_data(tmp_path / "data" / name, parallax, train=1000, test=100)
    shard = tmp_path / "data" / "a" / "train-00000.npz"
    arrays = read_shard(shard, mapped=False)
    whole = arrays["value_a"].copy()
    arrays["value_a"][3] = float("nan")
    write_shard(shard, arrays)
    command = ["mbtf-fit", "--many", str(tmp_path / "data"), "-o", str(tmp_path / "out"), *QUICK]
    done = call([*command, "--json"])
    assert done.code == 4, done.err
    assert "1 of 2 fits failed" in done.err
    broken, other = json.loads(done.out)["fits"]
    assert [Path(fit["material"]).name for fit in (broken, other)] == ["a", "b"]
    assert "train-00000.npz" in broken["error"]
    assert other["error"] is None
    assert other["result"]["training"]["steps"] == 6
    # Of the failed one nothing is left, nor of a command of which all fail.
    assert not (tmp_path / "out" / "a").exists()
    alone = call(["mbtf-fit", "--many", str(shard.parent), "-o", str(tmp_path / "none"), *QUICK])
    assert (alone.code, (tmp_path / "none").exists()) == (4, False)
    before = (tmp_path / "out" / "b" / "material.json").read_bytes()
    # After the repair, the same command finishes the one and leaves the other as it is.
    arrays["value_a"] = whole
    write_shard(shard, arrays)
    done = call(command)
    assert done.code == 0, done.err
    lines = done.out.splitlines()
    assert lines[0].startswith("material")
    assert [line.split()[0] for line in lines[1:3]] == ["a", "b"]
    assert (tmp_path / "out" / "b" / "material.json").read_bytes() == before


def test_data_sets_come_from_folders_and_folders_of_folders(tmp_path: Path) -> None:
    for name in ("x/one", "x/two", "three"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "manifest.json").write_text("{}")
    names = [p.relative_to(tmp_path).as_posix() for p in find_data([tmp_path / "x", tmp_path / "three"])]
    assert names == ["x/one", "x/two", "three"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="contains no data sets"):
        find_data([tmp_path / "empty"])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    for seed, name in enumerate(("a", "b", "c")):
        write_data(folder / name, parallax, train=1000, test=100, seed=seed)
    return folder


def test_a_fit_takes_model_and_network_from_the_folder(data: Path, tmp_path: Path) -> None:
    materials, narrow = tmp_path / "materials", ("--set", "network.width=16")
    words = ["--many", str(data / "a"), str(data / "b"), "--shared-decoder", "-o", str(materials)]
    done = call(["mbtf-fit", *words, *QUICK, *narrow])
    assert done.code == 0, done.err
    assert [line.split()[0] for line in done.out.splitlines()] == ["material", "a", "b"]
    wanted = network_tensors(Material.load(materials / "a").model)
    # A preset has another network.
    words = ["--decoder", str(materials / "a"), "-o", str(tmp_path / "m"), "--quality", "draft", *QUICK]
    done = call(["mbtf-fit", str(data / "c"), *words])
    assert done.code == 0, done.err
    found = Material.load(tmp_path / "m")
    assert found.config.network.width == 16
    own = network_tensors(found.model)
    assert all((own[name] == wanted[name]).all() for name in wanted)


def test_data_without_geometry_share_a_network_of_neumip(data: Path, tmp_path: Path) -> None:
    flat = write_data(tmp_path / "flat", constant(0.3), train=500, test=50)
    edit(flat / "manifest.json", lambda manifest: manifest.update(geometry=None))
    words = ["--many", str(data / "a"), str(flat), "--shared-decoder", "-o", str(tmp_path / "m"), *QUICK]
    done = call(["mbtf-fit", *words])
    assert done.code == 0, done.err
    assert Material.load(tmp_path / "m" / "flat").config.model == "neumip"


def test_a_model_that_traces_heights_is_refused_before_its_time_is_announced(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "data", constant(0.3), train=500, test=50)
    edit(folder / "manifest.json", lambda manifest: manifest.update(geometry=None))
    done = call(["mbtf-fit", str(folder), "--model", "relief", "-o", str(tmp_path / "m"), *QUICK])
    assert done.code == 3
    assert "has no geometry, which relief reads" in done.err
    assert "training for" not in done.err
    assert not (tmp_path / "m").exists()
