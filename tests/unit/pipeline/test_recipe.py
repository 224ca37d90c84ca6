"""Recipes: reading, errors with lines and hints, quality presets, and exit codes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.app.console import Console, run
from mbtf_core.app.options import Quality
from mbtf_core.config.settings import resolve
from mbtf_core.errors import InputError
from mbtf_core.files import folders
from mbtf_fit.config import FITTER, FitConfig
from mbtf_fit.sections import TimeBudget
from mbtf_gen.config.generator import GENERATOR
from mbtf_pipeline.cli.app import app
from mbtf_pipeline.recipe import (
    COMPARE,
    load_recipe,
    preset_recipe,
    quality_options,
    read_resolved,
    write_recipe,
)
from mbtf_pipeline.run import _material_inputs, _RecipeRun, data_sets, survey
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


def test_a_dry_run_lists_what_would_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run(app, ["run", str(written(tmp_path, SINGLE)), "-o", str(out), "--dry-run"]) == 0
    assert "generate: has not run\n" in capsys.readouterr().out
    assert not out.exists()
    assert run(app, ["run", str(written(tmp_path, SINGLE)), "-o", str(ROOT / "pipelines"), "--dry-run"]) == 3
    assert "holds no run" in capsys.readouterr().err


def test_data_that_do_not_fit_on_the_disk_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e3))
    assert run(app, ["run", str(written(tmp_path, SINGLE)), "-o", str(tmp_path / "out")]) == 3
    message = capsys.readouterr().err
    assert "1 kB are free" in message
    assert "--set" in message.splitlines()[-1]


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
        "fit:\n  one: &one {model: mine.py:Mine}\n  two: *one\n  neumip: {<<: *one, "
        "model: neumip, decoder: 's3://bucket/a'}\n  relief: {decoder: ../b}\n"
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
        assert (fit["neumip"].model, fit["neumip"].decoder) == ("neumip", "s3://bucket/a")
        assert fit["relief"].decoder == str(tmp_path.parent / "b")
        assert fit["rainer2020"].training.materials == (f"{tmp_path}/c", f"{tmp_path}/d")


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (NAMED.replace("time: 5s", "tmie: 5s"), 10, "did you mean 'time'"),
        (SINGLE.replace("maps/", "../nowhere/"), 3, "nowhere/height.npy' does not exist"),
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


QUALITIES: tuple[Quality, ...] = get_args(Quality)


@pytest.mark.parametrize("quality", QUALITIES)
def test_recipes_take_a_preset(quality: Quality) -> None:
    path = ROOT / "pipelines" / "quickstart.yaml"
    recipe = preset_recipe(path, quality)
    assert recipe.generate.queries.train == GENERATOR[quality]["queries.train"]
    plain = load_recipe(path)
    assert recipe.generate.light == plain.generate.light
    assert list(recipe.fit) == list(plain.fit)
    for fit in recipe.fit.values():
        expected = resolve(FitConfig, presets=FITTER[quality])
        assert fit.training.steps == expected.training.steps
        if expected.training.steps is None:
            assert fit.training.time.seconds == expected.training.time.seconds
    assert recipe.compare.size == COMPARE[quality]["compare.size"]


@pytest.mark.parametrize("name", ["models", "hierarchical"])
@pytest.mark.parametrize("quality", QUALITIES)
def test_recipes_that_compare_networks_keep_them(quality: Quality, name: str) -> None:
    path = ROOT / "pipelines" / f"{name}.yaml"
    plain, raised = load_recipe(path), load_recipe(path, presets=quality_options(path, quality))
    assert {n: f.network for n, f in raised.fit.items()} == {n: f.network for n, f in plain.fit.items()}
    for one, fit in raised.fit.items():
        if plain.fit[one].training.blur.initial_sigma == 0 or fit.model == "hierarchical":
            assert fit.training.blur == plain.fit[one].training.blur


def test_a_section_overrides_the_preset_value_by_value(tmp_path: Path) -> None:
    np.save(tmp_path / "height.npy", np.zeros((8, 8)))
    path = tmp_path / "recipe.yaml"
    path.write_text("name: r\ngenerate: {material: height.npy}\nfit: {neumip: {}}\n")
    for section, single in (
        ("fit.neumip={network: {width: 7}}", "fit.neumip.network.width=7"),
        ("fit={neumip: {training: {blur: {fraction: 0.4}}}}", "fit.neumip.training.blur.fraction=0.4"),
    ):
        found, expected = (preset_recipe(path, "draft", [text]) for text in (section, single))
        assert found == expected
        assert found.fit["neumip"].training.time == TimeBudget(12.0, 800)


def test_a_preset_sets_the_resolution_unless_told(tmp_path: Path) -> None:
    """A draft of large maps is a draft; explicit resolutions of recipes and assignments are kept."""
    np.save(tmp_path / "height.npy", np.zeros((256, 256)))
    path = tmp_path / "recipe.yaml"
    text = "name: r\ngenerate: {material: height.npy, geometry: {height_scale: 1}}\nfit: {model: neumip}\n"
    path.write_text(text)
    found = [preset_recipe(path, quality).generate.queries.resolution for quality in QUALITIES]
    # No finer than the map, whose own is the paper's.
    assert found == [128, 256, 256, None]
    told = preset_recipe(path, "draft", ["generate.queries.resolution=512"])
    assert told.generate.queries.resolution == 512


@pytest.mark.parametrize(("layout", "found"), [("slices", ["slices"]), ("shuffled", ["shuffled", "slices"])])
def test_models_of_queries_are_trained_on_slices_where_these_are_the_data(
    layout: str, found: list[str], tmp_path: Path
) -> None:
    file = tmp_path / "recipe.yaml"
    text = f"name: x\ngenerate: {{material: maps/, queries: {{layout: {layout}, train: 196/texel}}}}\n"
    (tmp_path / "maps").mkdir()
    file.write_text(text + "fit: {neumip: {}, rainer2019: {}}\n")
    assert [data.config.queries.layout for data in data_sets(load_recipe(file))] == found
