"""``mbtf-gen publish`` as a user runs it: publish, make the data again from the recipe alone, compare."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.commands import Done, run_named
from support.measured_files import btf
from support.published import contents

SMALL = "--height-scale 0.05 --resolution 8 --spp 4 --test-queries 64 --test-spp 16"
LINES = {
    "generate": f"wool {SMALL} --queries 20/texel -o shards --set output.shard_queries=500",
    "import": "import felt.btf --queries 300 --test-queries 20 --min-cos 0.2 -o felt",
    "publish": "publish shards --config said.yaml --form npz --with-maps -o card --json",
    "again": "publish shards --config said.yaml --form npz --with-maps -o card --json",
    "measured card": "publish felt --license CC0-1.0 --form npz -o felt_card",
    "copy": "verify card/data",
}
SAID = """\
license: CC-BY-4.0
author: [Ada Lovelace]
date: 2026-11-23
citation: |
  @misc{a,
    title = {b}
  }
"""


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("publish")
    (folder / "wool").mkdir()
    np.save(folder / "wool/height.npy", np.random.default_rng(0).random((8, 8)).astype(np.float32))
    (folder / "wool/material.yaml").write_text("height: height.npy\nbase_color: [0.8, 0.5, 0.2]\n")
    (folder / "felt.btf").write_bytes(btf())
    (folder / "said.yaml").write_text(SAID)
    return folder


@pytest.fixture(scope="module")
def done(work: Path) -> dict[str, Done]:
    return run_named(LINES, work)


def test_a_published_folder_is_complete(work: Path, done: dict[str, Done]) -> None:
    result = done["publish"].result()
    assert done["again"].result() == result
    files = set(contents(work / "card"))
    assert set(result["files"]) | {"publish.json"} == files
    expected = "README.md croissant.json data/manifest.json data/geometry.exr recipe/config.yaml"
    assert {*expected.split(), "recipe/material/height/height.npy", "contact_sheet.png"} <= files
    card = (work / "card/README.md").read_text()
    assert "# wool\n" in card
    assert "@misc{a,\n  title = {b}\n}" in card
    assert "no recipe: measured data" in done["measured card"].out


def test_the_recipe_makes_the_data_again(work: Path, done: dict[str, Done], tmp_path: Path) -> None:
    """By the commands of the card, in another folder, from the recipe alone."""
    assert done["publish"].code == 0
    (tmp_path / "card").mkdir()
    shutil.copytree(work / "card/recipe", tmp_path / "card/recipe")
    text = (work / "card/README.md").read_text()
    generate, compare = re.findall(r"^(mbtf-gen|cp) (.*)$", text, re.MULTILINE)
    again = run_named({"generate": generate[1]}, tmp_path / "card")
    assert again["generate"].code == 0, again["generate"].err
    line = ["sh", "-c", " ".join(compare)]
    said = subprocess.run(line, cwd=tmp_path / "card", capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
    assert said.stdout.count(": OK") == 5
    shards = [path.name for path in (work / "shards").glob("*.npz")]
    assert done["copy"].code == 0
    for name in (*shards, "geometry.exr"):
        assert (tmp_path / "remade" / name).read_bytes() == (work / "shards" / name).read_bytes()
