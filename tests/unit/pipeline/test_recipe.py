"""Recipes: reading, errors with lines and hints, and exit codes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mbtf_core.app.console import Console, run
from mbtf_core.errors import InputError
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.recipe import load_recipe, read_resolved, write_recipe
from mbtf_pipeline.run import _material_inputs, _RecipeRun, survey
from mbtf_pipeline.stages import run_stages

HEAD = """\
name: small
generate:
  material: maps/height.npy
  queries: {train: 4/texel}
"""
SINGLE = HEAD + "fit: {model: neumip}\n"
NAMED = (
    HEAD
    + """\
fit:
  neumip:
  quick:
    model: neumip-baseline
    training:
      time: 5s
"""
)


def written(folder: Path, text: str) -> Path:
    (folder / "maps").mkdir(exist_ok=True)
    np.save(folder / "maps" / "height.npy", np.zeros((4, 4), np.float32))
    path = folder / "recipe-under-test.yaml"
    path.write_text(text)
    return path


def test_paths_are_relative_to_the_recipe_or_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    np.save(elsewhere / "h.npy", np.zeros((2, 2), np.float32))
    monkeypatch.chdir(elsewhere)
    for text in (SINGLE, SINGLE.replace("maps/height.npy", "maps\\height.npy")):
        path = Path("..") / written(tmp_path, text).name
        recipe = load_recipe(path)
        assert Path(recipe.generate.material).samefile(tmp_path / "maps" / "height.npy")
    assert recipe.folder == Path("out") / "small"
    recipe = load_recipe(path, ["generate.material=h.npy", "compare.spp=32"])
    assert Path(recipe.generate.material).samefile(elsewhere / "h.npy")
    assert recipe.compare.spp == 32


def test_data_are_out_of_date_when_a_map_has_changed(tmp_path: Path) -> None:
    """By its content, not by its date."""
    recipe, folder = load_recipe(written(tmp_path, SINGLE)), tmp_path / "out"
    stages = _RecipeRun(recipe, folder, Console(quiet=True)).stages(_material_inputs(recipe))
    run_stages(folder, [replace(stage, outputs=(), run=lambda decision: None) for stage in stages])
    path = tmp_path / "maps" / "height.npy"
    path.touch()
    assert not survey(recipe, folder)["generate"]
    np.save(path, np.ones((4, 4), np.float32))
    assert survey(recipe, folder)["generate"] == "input changed: height"


def test_a_fit_is_out_of_date_when_the_file_of_its_model_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model is named by its class, and its path is relative to the current folder."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "mine.py"
    file.write_text(
        "from mbtf_fit.models.svbrdf import Svbrdf\n\n\n"
        "class Lobes(Svbrdf):\n    defaults = {'training': {'warmup': 7}}\n"
    )
    recipe = load_recipe(written(tmp_path, HEAD + "fit: {model: mine.py:Lobes}\n"))
    assert list(recipe.fit) == ["Lobes"]
    assert recipe.fit["Lobes"].training.warmup == 7

    def inputs() -> Mapping[str, str]:
        (stage,) = (
            s for s in _RecipeRun(recipe, tmp_path, Console(quiet=True)).stages({}) if s.name == "fit Lobes"
        )
        return stage.inputs

    before = inputs()
    assert inputs() == before
    file.write_text(file.read_text().replace("7", "8"))
    assert inputs() != before


@pytest.mark.parametrize(
    ("fit", "models"),
    [
        ("fit: {training: {time: 9s}}\n", {"relief": "relief"}),
        (NAMED.removeprefix(HEAD), {"neumip": "neumip", "quick": "neumip-baseline"}),
        ("fit: {neumip+: }\n", {"neumip+": "neumip+"}),
    ],
)
def test_names_and_models_default_to_each_other(tmp_path: Path, fit: str, models: dict[str, str]) -> None:
    recipe = load_recipe(written(tmp_path, HEAD + fit))
    assert {name: config.model for name, config in recipe.fit.items()} == models


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (SINGLE + "compare:\n  views:\n  - {elevation: 45, azimut: 3}\n", 8, "did you mean 'azimuth'"),
        (NAMED.replace("time: 5s", "tmie: 5s"), 10, "did you mean 'time'"),
        (HEAD + "fit:\n  other:\n", 6, "rainer2020"),
        (HEAD + "fit: {}\n", 5, "contains no fit"),
        (SINGLE + "compare: {tiles_across: [2, 2.0]}\n", 6, "same width twice"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, line: int, what: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_recipe(path)
    assert caught.value.where == f"{path}:{line}"
    assert what in caught.value.message


@pytest.mark.parametrize(
    ("arguments", "code", "what"),
    [
        (["run", "recipe-under-tset.yaml"], 3, "did you mean 'recipe-under-test.yaml'?"),
        (
            ["run", "recipe-under-test.yaml", "--set", "generate.material=no.exr"],
            3,
            "does not exist",
        ),
        (["run", "recipe-under-test.yaml", "--quality", "draft", "--set", "fit={}"], 2, "contains no fit"),
        (["run", "recipe-under-test.yaml", "-o", "maps"], 3, "not empty"),
        (["report", "maps"], 3, "contains no run"),
    ],
)
def test_exit_codes(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    code: int,
    what: str,
) -> None:
    written(tmp_path, SINGLE)
    monkeypatch.chdir(tmp_path)
    assert run(app, arguments) == code
    err = capsys.readouterr().err
    assert what in err
    assert len(err.splitlines()) <= 2


def test_the_resolved_recipe_can_be_run_again(tmp_path: Path) -> None:
    recipe = load_recipe(written(tmp_path, NAMED + "compare: {views: [{elevation: 45, azimuth: 10}]}\n"))
    folder = tmp_path / "deep" / "run"
    folder.mkdir(parents=True)
    write_recipe(recipe, folder)
    again = load_recipe(folder / "recipe.yaml")
    assert Path(again.generate.material).samefile(recipe.generate.material)
    others = {"exclude": {"generate": {"material"}}}
    assert again.model_dump(**others) == recipe.model_dump(**others)
    (tmp_path / "maps" / "height.npy").unlink()
    assert read_resolved(folder).fit == recipe.fit


def test_a_stored_recipe_runs_no_code(tmp_path: Path) -> None:
    """Of a run that somebody else has made: drawing its report again needs the configuration alone."""
    recipe, ran = load_recipe(written(tmp_path, NAMED)), tmp_path / "ran"
    code = tmp_path / "model.py"
    code.write_text(f"open({str(ran)!r}, 'w').close()\n")
    fits = {name: fit.model_copy(update={"model": f"{code}:Theirs"}) for name, fit in recipe.fit.items()}
    write_recipe(recipe.model_copy(update={"fit": fits}), tmp_path)
    assert read_resolved(tmp_path).fit == fits
    assert not ran.exists()
    with pytest.raises(InputError):
        load_recipe(tmp_path / "recipe.yaml")
    assert ran.exists()
