"""Whole runs of ``mbtf-gen``: forms of the command, pictures and their orientation."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import RunPython
from numpy.typing import NDArray
from PIL import Image
from support.commands import Done, run_all, run_named
from support.datasets import edit
from support.small_runs import write_maps

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import read_exr
from mbtf_core.data.verify import verify

Arrays = dict[str, NDArray[np.float32]]

# 16 texels across, 8 down.
MAP = (8, 16)
SMALL = "--queries 16/texel --test-queries 200 --test-spp 8 --set output.shard_queries=64"
PICTURES = "reference maps -o pictures --view 50,20 --light 60,80 --tiles-across 0.5,2 --size 24"


def write_material(folder: Path) -> None:
    """Heights and colors without any symmetry, in folder/maps; a description of them in folder."""
    write_maps(folder, MAP)
    (folder / "material.yaml").write_text("height: maps/height.npy\nbase_color: maps/base_color.png\n")


def load(folder: Path) -> dict[str, Arrays]:
    dataset = Dataset.open(folder)
    return {split: dataset.load(split) for split in dataset.splits}


def equal(a: Path, b: Path) -> bool:
    """Do two data sets hold the same bits?"""
    x, y = load(a), load(b)
    return x.keys() == y.keys() and all(
        x[s].keys() == y[s].keys() and all(np.array_equal(x[s][n], y[s][n]) for n in x[s]) for s in x
    )


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    write_material(folder)
    return folder


@pytest.fixture(scope="module")
def whole(work: Path, run_python: RunPython) -> Path:
    """An undisturbed run, made by the program itself."""
    out = ("-o", str(work / "whole"), "--json")
    done = run_python("-m", "mbtf_gen", str(work / "maps"), *SMALL.split(), *out)
    assert done.returncode == 0, done.stderr
    # Standard output is one JSON object and nothing else.
    summary = json.loads(done.stdout)
    assert summary["complete"] is True
    assert summary["queries"] == 16 * 8 * 16 + 200
    assert summary["paths"] == 16 * 8 * 16 * 4 + 200 * 8
    assert (summary["lost"], summary["capped"], summary["nonfinite"]) == (0, 0, 0)
    return work / "whole"


def test_the_data_set_is_intact_and_sane(whole: Path) -> None:
    assert verify(whole) == []
    data = load(whole)
    assert {split: len(arrays["sigma"]) for split, arrays in data.items()} == {"train": 2048, "test": 200}
    for arrays in data.values():
        value = 0.5 * (arrays["value_a"] + arrays["value_b"])
        assert (value >= 0).all()
        assert value.mean() > 0.01
        # Halves are two estimates, not one.
        assert np.mean(arrays["value_a"] != arrays["value_b"]) > 0.3


@pytest.fixture(scope="module")
def batch(work: Path, whole: Path) -> dict[str, Done]:
    """Many commands in one process."""
    shutil.copytree(whole, work / "unmerged")
    (work / "unmerged/test-00001.npz").unlink()
    edit(work / "unmerged/manifest.json", lambda manifest: manifest.update(complete=False))
    few = "--queries 2/texel --test-queries 100 --spp 2 --test-spp 2 --seed 3 --json"
    lines = {
        "unmerged": "merge unmerged",
        "file": f"maps/height.npy {few} -o file",
        "flags first": f"{few} -o first maps",
        "yaml": f"material.yaml {few} -o yaml",
        "set": "maps -o set --json --set queries.train=2/texel --set queries.test=100 --set queries.spp=2 "
        "--set queries.test_spp=2 --set seed=3",
        "reference": f"{PICTURES} --json --spp 4",
    }
    return run_named(lines, work)


def test_merging_what_is_not_there_is_partial(batch: dict[str, Done]) -> None:
    assert batch["unmerged"].code == 4
    assert "unfinished" in batch["unmerged"].out


def test_every_form_of_the_command_makes_the_same_data(batch: dict[str, Done], work: Path) -> None:
    for name in ("flags first", "yaml", "set", "file"):
        assert batch[name].result()["complete"] is True
    assert equal(work / "first", work / "yaml")
    assert equal(work / "first", work / "set")
    # A bare height map stands alone, gray: same queries, other values.
    gray, colored = load(work / "file")["train"], load(work / "first")["train"]
    assert np.array_equal(gray["u"], colored["u"])
    assert np.ptp(gray["value_a"], axis=-1).max() < 1e-6
    assert np.ptp(colored["value_a"], axis=-1).max() > 0.01


def test_reference_writes_pictures_for_people_and_programs(batch: dict[str, Done], work: Path) -> None:
    report = batch["reference"].result()
    stems = {f"{kind}-tiles{tiles_across}" for kind in ("query", "pixel") for tiles_across in ("0.5", "2")}
    assert {Path(p["file"]).stem for p in report["pictures"]} == stems
    for p in report["pictures"]:
        arrays = read_exr(work / p["file"])
        assert arrays["value_a"].shape == (1, 24, 24, 3)
        value = 0.5 * (arrays["value_a"] + arrays["value_b"])
        assert value.mean() > 0.01
        shown = np.asarray(Image.open((work / p["file"]).with_suffix(".png")))
        # The picture shows the values: brighter where they are brighter.
        assert np.corrcoef(shown.mean(axis=-1).ravel(), value.mean(axis=-1).ravel())[0, 1] > 0.8


# Quadrants of the map: top left, top right, bottom left, bottom right.
QUADRANTS = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "white": (1, 1, 1)}
COMMAND = "preview maps -o tilted --tiles 1 --size 96 --spp 4"


def write_inputs(folder: Path) -> None:
    """A material whose quadrants have different colors and heights; 2:1, so that nothing may be swapped."""
    (folder / "maps").mkdir()
    color = np.zeros((16, 32, 3), np.uint8)
    height = np.zeros((16, 32), np.float32)
    for (j, i), rgb, z in zip(np.ndindex(2, 2), QUADRANTS.values(), (0.04, 0.0, 0.02, 0.01), strict=True):
        part = (slice(8 * j, 8 * j + 8), slice(16 * i, 16 * i + 16))
        color[part] = 40 + 180 * np.array(rgb)
        height[part] = z
    Image.fromarray(color).save(folder / "maps/base_color.png")
    np.save(folder / "maps/height.npy", height)


def quadrant(picture: NDArray[np.float64]) -> NDArray[np.intp]:
    """Which of the four colors each pixel has; -1 where that is not clear."""
    colors = np.array(list(QUADRANTS.values()), np.float64)
    hue = picture / np.maximum(picture.max(axis=-1, keepdims=True), 0.05)
    distance = np.linalg.norm(hue[..., None, :] - colors, axis=-1)
    return np.where(distance.min(axis=-1) < 0.6, distance.argmin(axis=-1), -1)


def test_colors_lie_in_the_quadrants_of_the_map(tmp_path: Path) -> None:
    """The camera stands towards -v: the map's first row is far, its first column left."""
    write_inputs(tmp_path)
    (done,) = run_all([COMMAND.split()], tmp_path)
    assert done.code == 0, done.err
    picture = quadrant(np.asarray(Image.open(tmp_path / "tilted/beauty.png").convert("RGB")) / 255)
    # Positions close to the picture's middle, where the tile's middle is.
    for number, (down, right) in enumerate([(-5, -12), (-5, 12), (6, -12), (6, 12)]):
        part = picture[36 + down - 2 : 36 + down + 3, 48 + right - 4 : 48 + right + 5]
        assert (part == number).mean() > 0.8, number
