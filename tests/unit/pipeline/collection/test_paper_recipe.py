"""Paper recipes: order of layers, missing materials, and invalid input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT

from mbtf_core.errors import InputError
from mbtf_pipeline.collection.recipes import PaperRecipe, Planned, load
from mbtf_pipeline.collection.run import run_collection

PIPELINES = ROOT / "pipelines"
SHIPPED = sorted(PIPELINES.glob("paper_*.yaml"))
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


def written(folder: Path, text: str = TEXT) -> Path:
    (folder / "maps").mkdir(exist_ok=True)
    np.save(folder / "maps" / "height.npy", np.zeros((4, 4), np.float32))
    path = folder / "paper-under-test.yaml"
    path.write_text(text)
    return path


def paper_of(path: Path) -> PaperRecipe:
    found = load(path)
    assert isinstance(found, PaperRecipe)
    return found


def planned(path: Path, quick: bool = False) -> tuple[dict[str, Planned], dict[str, str]]:
    found, skipped = paper_of(path).plan(path, quick)
    assert len({one.name for one in found}) == len(found)
    return {one.name: one for one in found}, {name: str(one.path) for name, one in skipped.items()}


def test_order_of_layers(tmp_path: Path) -> None:
    path = written(tmp_path)
    full, _ = planned(path)
    quick, _ = planned(path, True)
    # The quick size overrides the base; options of a material override both.
    heights = [runs["here"].recipe.generate.geometry.height_scale for runs in (full, quick)]
    assert heights == [0.1, 0.2]
    assert {runs["steep"].recipe.generate.geometry.height_scale for runs in (full, quick)} == {0.5}
    assert quick["here"].recipe.generate.geometry.mesh == 8
    assert quick["here"].recipe.generate.queries.resolution == 4
    # A fit's own options override those of every fit.
    fits = quick["here"].recipe.fit
    assert [(name, f.model) for name, f in fits.items()] == [("neumip-baseline",) * 2, ("wide", "neumip")]
    assert [f.training.steps for f in fits.values()] == [3, 3]
    assert [f.training.batch for f in fits.values()] == [64, 32]
    assert fits["wide"].network.width == 40


def test_every_variant_is_one_run(tmp_path: Path) -> None:
    text = TEXT + "variants:\n  few: {generate: {queries: {train: 2/texel}}}\n  many: {}\n"
    runs, _ = planned(written(tmp_path, text), True)
    assert list(runs) == ["here-few", "here-many", "steep-few", "steep-many"]
    counts = [runs[name].recipe.generate.queries.train for name in ("here-few", "here-many")]
    assert counts == ["2/texel", "4/texel"]


def test_missing_materials_are_skipped_and_listed(tmp_path: Path) -> None:
    path = written(tmp_path)
    runs, missing = planned(path)
    assert list(runs) == ["here", "steep"]
    assert missing == {"elsewhere": str(tmp_path / "maps" / "nowhere.npy")}
    (tmp_path / "maps" / "height.npy").unlink()
    with pytest.raises(InputError, match="no material can be run"):
        planned(path)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (("train: 4/texel", "tarin: 4/texel"), "queries.tarin"),
        (("base:", "bass:"), "bass"),
        (("tables: [methods]", "tables: [method]"), "tables.0"),
        (("wide: {model: neumip", "wide: {model: newmip"), "fit.wide"),
        (("steep: {generate: {material: maps/height.npy, ", "steep: {generate: {"), "steep"),
    ],
)
def test_errors_name_the_key(tmp_path: Path, change: tuple[str, str], key: str) -> None:
    path = written(tmp_path, TEXT.replace(*change))
    with pytest.raises(InputError) as raised:
        planned(path, True)
    assert key in str(raised.value)


def test_a_fit_of_other_materials_needs_some(tmp_path: Path) -> None:
    """Before anything is generated."""
    text = (
        "name: lonely\ntables: [methods]\nlearn_from_others: [rainer2020]\n"
        "materials:\n  here: maps/height.npy\n"
        "base:\n  generate: {queries: {train: 4/texel, resolution: 4}}\n"
        "  fit:\n    rainer2020: {training: {own_material: false}}\n"
    )
    path = written(tmp_path, text)
    with pytest.raises(InputError, match="learns from other materials alone, but there are none"):
        run_collection(paper_of(path), path, tmp_path / "out", command="")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("path", SHIPPED, ids=[p.stem for p in SHIPPED])
def test_shipped_recipes_are_valid_and_quick_is_smaller(path: Path) -> None:
    full, missing = planned(path)
    quick, _ = planned(path, True)
    assert list(full) == list(quick)
    assert all("shared" in where for where in missing.values())
    for name, large in full.items():
        small = quick[name].recipe
        assert small.compare.size <= large.recipe.compare.size
        assert small.compare.spp <= large.recipe.compare.spp
        assert int(small.generate.queries.test) <= int(large.recipe.generate.queries.test)
        assert (small.generate.queries.resolution or 99) < (large.recipe.generate.queries.resolution or 0)
        assert small.fit.keys() == large.recipe.fit.keys()
