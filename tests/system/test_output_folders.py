"""Output folders: one command at a time writes to them, and one that is killed between any two of its files
writes, run again, what it would have written."""

from __future__ import annotations

import itertools
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.commands import call
from support.datasets import write_dataset
from support.fit_data import parallax, write_data
from support.plugin_materials import write_material
from support.published import contents

from mbtf_core.files.atomic import write_chunks
from mbtf_core.files.folders import owned
from mbtf_gen.publishing import publication

PICTURES = "--size 8 --spp 2 --view 50,20 --light 60,80 --tiles-across 2"
COMMANDS = {
    # Links files, where other forms write them.
    "publish": "mbtf-gen publish set --license CC0-1.0 --form npz",
    "reference": f"mbtf-gen reference heights.npy {PICTURES}",
    "preview": "mbtf-gen preview heights.npy --size 64 --spp 2",
    "export": "mbtf-fit export material --to exr --to json --to material",
    "compare": f"mbtf-fit compare material set {PICTURES}",
}


class Killed(BaseException):
    """In place of the end of the process, which no handler sees."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    np.save(folder / "heights.npy", 0.1 * np.random.default_rng(0).random((4, 8)))
    (folder / "recipe.yaml").write_text(RECIPE)
    write_data(folder / "shards", parallax, train=600)
    write_dataset(folder / "set", queries={"train": "40", "test": "8"})
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


RECIPE = "name: r\ngenerate: {material: heights.npy, queries: {train: 64, test: 16}}\nfit: {model: neumip}\n"
WRITERS = [
    "mbtf-fit shards --steps 5 -o out",
    "mbtf-fit shards --steps 5 -o out --overwrite",
    "mbtf-fit export material -o out",
    "mbtf-fit export material --to material -o out",
    "mbtf-fit preview material -o out",
    "mbtf-gen preview heights.npy -o out",
    "mbtf-gen publish set --license CC0-1.0 --form npz -o out",
    "mbtf-gen publish set --license CC0-1.0 --form npz -o out --overwrite",
    "mbtf-gen reference heights.npy -o out",
    "mbtf-gen reference heights.npy -o out --overwrite",
    "mbtf-pipeline run recipe.yaml -o out",
    "mbtf-pipeline cost recipe.yaml -o out",
]


@pytest.mark.parametrize("command", WRITERS)
def test_a_folder_in_use_is_refused(inputs: Path, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(inputs)
    with owned(Path("out")):
        before = sorted(inputs.rglob("*"))
        done = call(command.split())
        assert done.code == 4, done.err
        lines = done.err[done.err.index("error: ") :].splitlines()
        assert lines[0].startswith(
            f"error: out: is being written by another process (process {os.getpid()} on "
        )
        assert lines[1:] == ["  wait for it and run the same command again, or choose another folder with -o"]
        assert sorted(inputs.rglob("*")) == before
    assert not Path("out").exists()


def test_two_fits_into_one_folder(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second one would leave its configuration beside the weights of the first."""
    from mbtf_fit.training import fit as module

    monkeypatch.chdir(inputs)
    train, codes = module._train, []

    def meanwhile(*arguments: object) -> None:
        monkeypatch.setattr(module, "_train", train)
        codes.append(call(["mbtf-fit", "shards", "--steps", "7", "-o", "fit", "--overwrite"]).code)
        train(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "_train", meanwhile)
    assert call(["mbtf-fit", "shards", "--steps", "5", "-o", "fit"]).code == 0
    assert codes == [4]
    assert "steps: 5" in Path("fit/config.yaml").read_text()
    assert call(["mbtf-fit", "info", "fit", "--json"]).code == 0
