"""Recipes: reading, errors with lines and hints, and exit codes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbtf_core.app.console import Console, run
from mbtf_core.errors import InputError
from mbtf_gen.generation import run as generation
from mbtf_gen.job import Job
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.recipe import load_recipe, read_resolved, write_recipe
from mbtf_pipeline.run import _material_inputs, _RecipeRun, survey
from mbtf_pipeline.stages import NOT_RUN, Decision, run_stages

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


def test_the_material_is_relative_to_the_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    for text in (SINGLE, SINGLE.replace("maps/height.npy", "maps\\height.npy")):
        path = written(tmp_path, text)
        recipe = load_recipe(Path("..") / path.name)
        assert Path(recipe.generate.material).samefile(tmp_path / "maps" / "height.npy")
    assert recipe.folder == Path("out") / "small"


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
    """The model is named by its class, and its path is relative to the recipe."""
    monkeypatch.chdir("/")
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


def test_every_path_is_relative_to_the_recipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in the resolved recipe of a run's folder; names of models are no paths, nor are URLs."""
    monkeypatch.chdir("/")
    (tmp_path / "mine.py").write_text(
        "from mbtf_fit.models.svbrdf import Svbrdf\n\n\nclass Mine(Svbrdf):\n    pass\n"
    )
    fits = (
        "fit:\n  one: &one {model: mine.py:Mine, init_from: fits/a}\n  two: *one\n  neumip: {<<: *one, "
        "model: neumip, init_from: 's3://bucket/a'}\n  relief: {decoder: ../b}\n"
        "  rainer2020: {training: {materials: [c, d]}}\noutput: run\n"
    )
    recipe = load_recipe(written(tmp_path, HEAD + fits))
    folder = tmp_path / "run"
    folder.mkdir()
    write_recipe(recipe, folder)
    for found in (recipe, load_recipe(folder / "recipe.yaml"), read_resolved(folder)):
        fit = found.fit
        assert Path(found.generate.material) == tmp_path / "maps" / "height.npy"
        assert found.folder == folder
        assert fit["one"].model == fit["two"].model == f"{tmp_path}/mine.py:Mine"
        assert fit["one"].init_from == fit["two"].init_from == f"{tmp_path}/fits/a"
        assert (fit["neumip"].model, fit["neumip"].init_from) == ("neumip", "s3://bucket/a")
        assert fit["relief"].decoder == str(tmp_path.parent / "b")
        assert fit["rainer2020"].training.materials == (f"{tmp_path}/c", f"{tmp_path}/d")


def test_the_material_of_two_data_sets_is_announced_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its warnings, too."""
    recipe = load_recipe(written(tmp_path, HEAD + "fit: {svbrdf: , hierarchical: }\n"))
    announced, generated = list[Job](), list[Job]()

    def generate(job: Job, *_: Any, **__: Any) -> Any:
        generated.append(job)
        return SimpleNamespace(shard_seconds=1.0)

    monkeypatch.setattr(Job, "announce", lambda job: announced.append(job))
    monkeypatch.setattr(generation, "generate", generate)
    for stage in _RecipeRun(recipe, tmp_path / "run", Console(quiet=True)).stages({})[:2]:
        stage.run(Decision(NOT_RUN))
    assert (len(announced), len(generated)) == (1, 2)


def test_an_assigned_material_is_relative_to_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, SINGLE)
    other = tmp_path / "other"
    other.mkdir()
    np.save(other / "h.npy", np.zeros((2, 2), np.float32))
    monkeypatch.chdir(other)
    recipe = load_recipe(path, ["generate.material=h.npy", "compare.spp=32"])
    assert Path(recipe.generate.material).samefile(other / "h.npy")
    assert recipe.compare.spp == 32


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
        (SINGLE + "compare: {tiles_across: [2, 2.0]}\n", 6, "same entry twice"),
    ],
)
def test_errors_name_the_line(tmp_path: Path, text: str, line: int, what: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_recipe(path)
    assert caught.value.where == f"{path}:{line}"
    assert what in caught.value.message


def test_a_missing_material_is_one_clear_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = written(tmp_path, SINGLE.replace("maps/height.npy", "../nowhere/height.exr"))
    assert run(app, ["run", str(path), "-o", str(tmp_path / "out")]) == 3
    out, err = capsys.readouterr()
    first, second = err.splitlines()
    searched = os.path.abspath(tmp_path / "../nowhere/height.exr")
    assert first == f"error: {path}:3: material '{searched}' does not exist"
    assert second.strip() == f"searched for {searched}"
    assert out == ""
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "what"),
    [
        (["run", "recipe-under-tset.yaml"], 3, "did you mean 'recipe-under-test.yaml'?"),
        (["run", "recipe-under-test.yaml", "--set", "compare.sp=2"], 2, "did you mean 'spp'"),
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
