"""A command that is killed between any two of its files, and run again, writes what it would have written."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.command_lines import call
from support.datasets import write_dataset
from support.plugin_materials import write_material
from support.published import contents

from mbtf_core.files.atomic import write_chunks
from mbtf_gen.publishing import publication

PICTURES = "--size 8 --spp 2 --view 50,20 --light 60,80 --tiles-across 2"
COMMANDS = {
    # Links files, where other forms write them.
    "publish": "mbtf-gen publish shards --license CC0-1.0 --form npz",
    "reference": f"mbtf-gen reference heights.npy {PICTURES}",
    "preview": "mbtf-gen preview heights.npy --size 64 --spp 2",
    "export": "mbtf-fit export material --to exr --to json --to material",
    "compare": f"mbtf-fit compare material shards {PICTURES}",
}


class Killed(BaseException):
    """In place of the end of the process, which no handler sees."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    np.save(folder / "heights.npy", 0.1 * np.random.default_rng(0).random((4, 8)))
    write_dataset(folder / "shards", queries={"train": "40", "test": "8"})
    write_material(folder / "material", finest=3, aspect=0.5)
    return folder


@pytest.fixture(autouse=True)
def quick_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without pictures, which take seconds."""
    monkeypatch.setattr(publication, "write_picture", lambda *arguments: write_chunks(arguments[-1], [b"it"]))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_killed_command_resumes(
    command: str, inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed before and after each file gets its name; before, with its unfinished file left behind."""
    monkeypatch.chdir(inputs)
    replace, left = os.replace, itertools.count()
    stop: tuple[int, bool] | None = None

    def replacing(source: Path, target: Path) -> None:
        number, kill = next(left), stop
        now = kill is not None and number == kill[0]
        if now and not kill[1]:
            # As another process left it.
            shutil.copy(source, Path(source).with_name(f".{Path(target).name}.deadbeef-1.tmp"))
            raise Killed
        replace(source, target)
        if now:
            raise Killed

    monkeypatch.setattr(os, "replace", replacing)

    def run(folder: Path) -> dict[str, bytes]:
        done = call([*COMMANDS[command].split(), "-o", str(folder)])
        assert done.code == 0, done.err
        return contents(folder)

    left = itertools.count()
    whole = run(tmp_path / "whole")
    assert len(whole) > 2
    for number, after in itertools.product(range(next(left)), (False, True)):
        left, stop, folder = itertools.count(), (number, after), tmp_path / f"{number}-{after}"
        with pytest.raises(Killed):
            call([*COMMANDS[command].split(), "-o", str(folder)])
        stop = None
        again = run(folder)
        assert again.keys() == whole.keys(), (number, after)
        assert [name for name in whole if again[name] != whole[name]] == [], (number, after)
        shutil.rmtree(folder)
