"""Which runs a library or a paper has, and with which options."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.errors import InputError, UsageError
from mbtf_pipeline.collection import recipes
from mbtf_pipeline.collection.recipes import Collection
from mbtf_pipeline.recipe import Recipe

BASE = "base: {generate: {queries: {train: 10/texel}}}\n"
SHIPPED = sorted([*(ROOT / "pipelines").glob("paper_*.yaml"), ROOT / "pipelines" / "benchmark.yaml"])
TEXT = """\
name: small
tables: [methods]
materials:
  here: maps/height.npy
  elsewhere: maps/nowhere.npy
  steep: {generate: {material: maps/height.npy, geometry: {height_scale: 0.5}}}
base:
  generate: {geometry: {height_scale: 0.1, mesh: 8}, queries: {train: 400/texel, resolution: 4}}
  each_fit: {training: {steps: 500, batch: 64}}
  fit:
    neumip-baseline:
    wide: {model: neumip, network: {width: 40}, training: {batch: 32}}
quick:
  generate: {geometry: {height_scale: 0.2}, queries: {train: 4/texel}}
  each_fit: {training: {steps: 3}}
"""


def material(folder: Path) -> Path:
    folder.mkdir(parents=True)
    np.save(folder / "height.npy", np.zeros((4, 4), np.float32))
    (folder / "material.yaml").write_text("height: height.npy\n")
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of two materials, a broken one, and something else; another with one of the same name."""
    for name in ("shell", "wool"):
        material(tmp_path / "assets" / name)
    (tmp_path / "assets" / "broken").mkdir()
    (tmp_path / "assets" / "broken" / "material.yaml").write_text("heigth: x.png\n")
    (tmp_path / "assets" / "scripts").mkdir()
    (tmp_path / "assets" / "scripts" / "make.py").write_text("")
    material(tmp_path / "more" / "wool")
    (tmp_path / "more" / "list.txt").write_text("# a comment\nwool\nmissing\n", encoding="utf-8-sig")
    return tmp_path


def planned(file: Path, quick: bool = False) -> tuple[dict[str, Recipe], dict[str, str]]:
    """Recipes by name of the run, and errors of the materials that are skipped."""
    found = recipes.load(file)
    assert isinstance(found, Collection)
    runs, skipped = found.plan(file, quick)
    return {one.name: one.recipe for one in runs}, {name: one.error for name, one in skipped.items()}


def load(folder: Path, text: str) -> tuple[dict[str, Recipe], dict[str, str]]:
    (folder / "library.yaml").write_text(f"name: test\n{text}")
    return planned(folder / "library.yaml")


def test_folders_lists_and_broken_materials(folder: Path) -> None:
    found, errors = load(folder, "library: [assets, more/list.txt]\n" + BASE)
    assert list(found) == ["shell", "assets-wool", "more-wool"]
    assert "heigth" in errors["broken"]
    assert errors["missing"].endswith("more/missing does not exist")


def test_faults_of_the_recipe(folder: Path) -> None:
    (folder / "more" / "empty").mkdir()
    for text, what in (
        ("library: [assets]\nmaterials:\n  shel: {fit: {relief: {}}}\n" + BASE, r"\.shel\b.*no material of"),
        (f"library: [{'x' * 300}]\n" + BASE, "is not a valid file name"),
        ("library: [more/empty]\n" + BASE, "names no material"),
        ("library: [assets]\nbase:\n  generate:\n    querys: {}\n", r"base: unknown key 'generate\.querys'"),
        ("materials: {rock: assets/cliff_rock}\n" + BASE, "key 'tables' is missing"),
        ("library: [assets]\nbase:\n  each_fit: {trainig: {}}\n", r"base: .*'fit\.relief\.trainig'"),
    ):
        with pytest.raises(InputError, match=what):
            load(folder, text)
    (folder / "link").symlink_to(folder / "assets" / "shell")
    for again in ("assets/shell", "link"):
        with pytest.raises(UsageError, match="listed twice"):
            load(folder, f"library: [assets/shell, {again}]\n" + BASE)
    (folder / "list.txt").write_text("assets/shell\n\0\n")
    with pytest.raises(InputError, match=r"list\.txt: is no list of paths"):
        load(folder, "library: [list.txt]\n" + BASE)
    with pytest.raises(InputError, match=r"materials\.steep: has no path"):
        planned(written(folder, TEXT.replace("material: maps/height.npy, ", "")))


def test_a_file_and_what_it_names_are_one_material(tmp_path: Path) -> None:
    for name in ("shirt", "sleeve", "other"):
        (tmp_path / f"{name}.obj").write_text("")
    (tmp_path / "shirt.yaml").write_text("mesh: shirt.obj\nparts: [{file: ./sleeve.obj}]\n")
    # The recipe itself is no material, nor is what an earlier run has written.
    material(tmp_path / "out" / "runs")
    (tmp_path / "out" / "collection.json").write_text("{}")
    found = load(tmp_path, "library: [.]\n" + BASE)
    assert sorted({**found[0], **found[1]}) == ["other", "shirt"]


def written(folder: Path, text: str = TEXT) -> Path:
    (folder / "maps").mkdir(exist_ok=True)
    np.save(folder / "maps" / "height.npy", np.zeros((4, 4), np.float32))
    path = folder / "paper-under-test.yaml"
    path.write_text(text)
    return path


def test_order_of_layers(tmp_path: Path) -> None:
    path = written(tmp_path)
    full, _ = planned(path)
    quick, _ = planned(path, True)
    # The quick size overrides the base; options of a material override both.
    heights = [runs["here"].generate.geometry.height_scale for runs in (full, quick)]
    assert heights == [0.1, 0.2]
    assert {runs["steep"].generate.geometry.height_scale for runs in (full, quick)} == {0.5}
    assert quick["here"].generate.geometry.mesh == 8
    # A fit's own options override those of every fit.
    fits = quick["here"].fit
    assert [f.training.steps for f in fits.values()] == [3, 3]
    assert [f.training.batch for f in fits.values()] == [64, 32]
    assert fits["wide"].network.width == 40


def test_paths_of_every_layer_are_relative_to_the_recipe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir("/")
    text = TEXT.replace("neumip-baseline", "neumip")
    text = text.replace("{training: {steps: 500,", "{decoder: base, training: {steps: 500,")
    text = text.replace("{training: {steps: 3}}", "{decoder: quick}")
    text = text.replace("height_scale: 0.5}}}", "height_scale: 0.5}}, each_fit: {decoder: own}}")
    path = written(tmp_path, text)
    for quick, name in ((False, "base"), (True, "quick")):
        runs, _ = planned(path, quick)
        for run, layer in (("here", name), ("steep", "own")):
            assert {fit.decoder for fit in runs[run].fit.values()} == {str(tmp_path / layer)}


def test_every_variant_is_one_run(tmp_path: Path) -> None:
    text = TEXT + "variants:\n  few: {generate: {queries: {train: 2/texel}}}\n  many: {}\n"
    runs, _ = planned(written(tmp_path, text), True)
    assert list(runs) == ["here-few", "here-many", "steep-few", "steep-many"]
    counts = [runs[name].generate.queries.train for name in ("here-few", "here-many")]
    assert counts == ["2/texel", "4/texel"]


def test_fits_are_repeated_with_seeds_or_left_out(tmp_path: Path) -> None:
    material(tmp_path / "maps")
    text = TEXT.replace("  fit:\n", "  seeds: [3, 5]\n  fit:\n").replace("quick:\n", "quick:\n  seeds: [7]\n")
    text = text.replace("  here: maps/height.npy", "  here: {generate: {material: maps}, without: [wide]}")
    (tmp_path / "small.yaml").write_text(text)
    full, quick = (planned(tmp_path / "small.yaml", size)[0] for size in (False, True))
    wanted = [f"{name}-seed{seed}" for seed in (3, 5) for name in ("neumip-baseline", "wide")]
    assert list(full["steep"].fit) == wanted
    assert [fit.seed for fit in full["steep"].fit.values()] == [3, 3, 5, 5]
    assert {fit.model for name, fit in full["steep"].fit.items() if "wide" in name} == {"neumip"}
    assert full["steep"].fit["wide-seed5"].training.batch == 32
    assert list(full["here"].fit) == ["neumip-baseline-seed3", "neumip-baseline-seed5"]
    assert list(quick["here"].fit) == ["neumip-baseline-seed7"]
    assert [recipes.seedless(name) for name in wanted[:2]] == ["neumip-baseline", "wide"]
    quickly = text.replace("quick:\n", "quick:\n  without: [neumip-baseline]\n")
    (tmp_path / "small.yaml").write_text(quickly)
    assert list(planned(tmp_path / "small.yaml", quick=True)[0]["steep"].fit) == ["wide-seed7"]
    for faulty, what in (("wdie", "names no fit: wdie"), ("wide, neumip-baseline", "leaves no fit")):
        (tmp_path / "small.yaml").write_text(TEXT.replace("base:", f"base:\n  without: [{faulty}]"))
        with pytest.raises(InputError, match=what):
            planned(tmp_path / "small.yaml")


@pytest.mark.parametrize("path", SHIPPED, ids=[p.stem for p in SHIPPED])
def test_shipped_recipes_are_valid_and_quick_is_smaller(path: Path) -> None:
    full, missing = planned(path)
    quick, _ = planned(path, True)
    assert list(full) == list(quick)
    assert all("/shared/" in error for error in missing.values())
    for name, large in full.items():
        small = quick[name]
        assert small.compare.size <= large.compare.size
        assert small.compare.spp <= large.compare.spp
        assert int(small.generate.queries.test) <= int(large.generate.queries.test)
        assert (small.generate.queries.resolution or 99) < (large.generate.queries.resolution or 0)
        assert set(map(recipes.seedless, small.fit)) == set(map(recipes.seedless, large.fit))


def test_the_shipped_library_has_its_assets() -> None:
    file = ROOT / "pipelines" / "library.yaml"
    found = recipes.load(file)
    assert isinstance(found, Collection)
    planned, skipped = found.plan(file)
    assert len(planned) >= 5
    assert not skipped
