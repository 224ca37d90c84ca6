"""One command at a time writes to a folder: the others are refused in words and leave it as it is."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from support.command_lines import call
from support.datasets import write_dataset
from support.fit_data import parallax, write_data
from support.plugin_materials import write_material

from mbtf_core.files.folders import owned

RECIPE = "name: r\ngenerate: {material: heights.npy, queries: {train: 64, test: 16}}\nfit: {model: neumip}\n"
COMMANDS = [
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


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("owner")
    np.save(folder / "heights.npy", np.outer(np.hanning(16), np.hanning(16)).astype(np.float32) * 0.1)
    (folder / "recipe.yaml").write_text(RECIPE)
    write_data(folder / "shards", parallax, train=600)
    write_material(folder / "material", finest=1)
    write_dataset(folder / "set", queries={"train": "40", "test": "8"})
    return folder


@pytest.mark.parametrize("command", COMMANDS)
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
