"""Which materials a library has, and with which options."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mbtf_core.errors import InputError, UsageError
from mbtf_pipeline.collection import recipes
from mbtf_pipeline.collection.recipes import Collection
from mbtf_pipeline.recipe import Recipe

BASE = "base: {generate: {queries: {train: 10/texel}}}\n"


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


def load(folder: Path, text: str) -> tuple[dict[str, Recipe], dict[str, str]]:
    """Recipes by name of the material, and errors of the others."""
    file = folder / "library.yaml"
    file.write_text(f"name: test\n{text}")
    library = recipes.load(file)
    assert isinstance(library, Collection)
    planned, skipped = library.plan(file)
    return {one.name: one.recipe for one in planned}, {name: one.error for name, one in skipped.items()}


def test_folders_lists_and_broken_materials(folder: Path) -> None:
    found, errors = load(folder, "library: [assets, more/list.txt]\n" + BASE)
    assert list(found) == ["shell", "assets-wool", "more-wool"]
    assert "heigth" in errors["broken"]
    assert errors["missing"].endswith("more/missing does not exist")


def test_own_options_and_further_materials(folder: Path) -> None:
    text = "library: [assets/shell]\n" + BASE
    text += "materials:\n  shell: {generate: {geometry: {height_scale: 0.5}}}\n  fleece: more/wool\n"
    found, _ = load(folder, text)
    shell, fleece = found["shell"], found["fleece"]
    assert shell.generate.geometry.height_scale == 0.5
    assert shell.generate.queries.train == "10/texel"
    assert fleece.generate.geometry.height_scale is None
    assert Path(fleece.generate.material) == folder / "more" / "wool"
    assert list(shell.fit) == ["relief"]


def test_cloths_get_the_model_without_geometry(folder: Path) -> None:
    cloth = folder / "assets" / "cloth"
    cloth.mkdir()
    (cloth / "material.yaml").write_text("weave: plain\n")
    found, _ = load(folder, "library: [assets/cloth]\n" + BASE)
    assert list(found["cloth"].fit) == ["neumip+"]


def test_faults_of_the_recipe(folder: Path) -> None:
    with pytest.raises(InputError, match=r"materials\.shel\b.*no material of the library"):
        load(folder, "library: [assets]\nmaterials:\n  shel: {fit: {relief: {}}}\n" + BASE)
    (folder / "link").symlink_to(folder / "assets" / "shell")
    for again in ("assets/shell", "link"):
        with pytest.raises(UsageError, match="listed twice"):
            load(folder, f"library: [assets/shell, {again}]\n" + BASE)
    (folder / "list.txt").write_text("assets/shell\n\0\n")
    with pytest.raises(InputError, match=r"list\.txt: is no list of paths"):
        load(folder, "library: [list.txt]\n" + BASE)
    with pytest.raises(InputError, match="is not a valid file name"):
        load(folder, f"library: [{'x' * 300}]\n" + BASE)
    (folder / "empty").mkdir()
    with pytest.raises(InputError, match="names no material"):
        load(folder, "library: [empty]\n" + BASE)


def test_equal_names_are_numbered(tmp_path: Path) -> None:
    for name in ("木", "石", "oak dark", "oak_dark"):
        material(tmp_path / "u" / name)
    assert sorted(load(tmp_path, "library: [u]\n" + BASE)[0]) == [
        *("u-material", "u-material-2", "u-oak_dark", "u-oak_dark-2")
    ]


def test_a_file_and_what_it_names_are_one_material(tmp_path: Path) -> None:
    for name in ("shirt", "sleeve", "other"):
        (tmp_path / f"{name}.obj").write_text("")
    (tmp_path / "shirt.yaml").write_text("mesh: shirt.obj\nparts: [{file: ./sleeve.obj}]\n")
    # The recipe itself is no material, nor is what an earlier run has written.
    material(tmp_path / "out" / "runs")
    (tmp_path / "out" / "collection.json").write_text("{}")
    found = load(tmp_path, "library: [.]\n" + BASE)
    assert sorted({**found[0], **found[1]}) == ["other", "shirt"]


def test_folders_of_folders_and_stray_pictures(tmp_path: Path) -> None:
    material(tmp_path / "q" / "group" / "a")
    material(tmp_path / "q" / "b")
    np.save(material(tmp_path / "q" / "c") / "more.npy", np.zeros((4, 4), np.float32))
    (tmp_path / "q" / "preview.png").write_bytes(b"")
    (tmp_path / "q" / "unclear").mkdir()
    (tmp_path / "q" / "unclear" / "wood.png").write_bytes(b"")
    (tmp_path / "q" / "loop").symlink_to(tmp_path / "q", target_is_directory=True)
    for hidden in (".cache", "_old"):
        material(tmp_path / "q" / hidden / "d")
    found, errors = load(tmp_path, "library: [q]\n" + BASE)
    assert list(found) == ["b", "c", "a"]
    assert "height" in errors["unclear"]


def test_a_fault_of_the_base_is_one_error(folder: Path) -> None:
    base = "library: [assets]\nbase:\n  generate:\n    querys: {train: 10/texel}\n"
    with pytest.raises(InputError, match=r"library\.yaml: base: unknown key 'generate\.querys'"):
        load(folder, base)
    with pytest.raises(InputError, match=r"library\.yaml: base: unknown key 'fit\.relief\.trainig'"):
        load(folder, "library: [assets]\nbase:\n  each_fit: {trainig: {batch: 5}}\n")


@pytest.mark.parametrize("key", ["time: 3s", "steps: 10"])
def test_one_training_time_of_all_or_of_each(folder: Path, key: str) -> None:
    own = "training: 10s\nlibrary: [assets]\n" + BASE
    with pytest.raises(InputError, match=r"materials\.shell: 'relief' has a training time"):
        load(folder, f"{own}materials: {{shell: {{fit: {{relief: {{training: {{{key}}}}}}}}}}}\n")
    with pytest.raises(InputError, match=r"base: 'each_fit' has a training time"):
        load(folder, f"training: 10s\nlibrary: [assets]\nbase: {{each_fit: {{training: {{{key}}}}}}}\n")
