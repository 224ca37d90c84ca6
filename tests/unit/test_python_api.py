"""Mistakes in Python are refused as on the command line: in one line, with what to write instead."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import mbtf_fit
import mbtf_gen
from mbtf_fit import FitConfig, Material, fit, fit_jointly
from mbtf_gen import Camera, Dataset, GeneratorConfig, generate, load_material, render_reference, verify

CONFIG = GeneratorConfig(material="rock")
MISTAKES: dict[str, tuple[Callable[[], object], str]] = {
    "misspelt section": (lambda: GeneratorConfig(material="rock", quries={}), "'queries'"),
    "key of a section": (lambda: GeneratorConfig(material="rock", spp=4), "'queries.spp'"),
    "value for a section": (lambda: GeneratorConfig(material="rock", queries="9/texel"), "keys: train"),
    "wrong type": (lambda: FitConfig(training={"steps": "many"}), "training.steps"),
    "no names": (lambda: GeneratorConfig("rock"), "GeneratorConfig(material="),
    "change": (lambda: setattr(CONFIG, "seed", 1), "make another GeneratorConfig"),
    "plain data to generate": (lambda: generate({"material": "rock"}, "out"), "GeneratorConfig("),
    "path to render": (lambda: render_reference("rock", Camera(), [0, 0, 1]), "GeneratorConfig("),
    "slice beyond the last": (lambda: generate(CONFIG, "out", slice_index=3, slice_count=2), "slice_index"),
    "no folder": (lambda: generate(CONFIG, None), "path or URL"),
    "data set not opened": (lambda: Dataset("small"), "Dataset.open('small')"),
    "folder to load": (lambda: Dataset.load("small"), "Dataset.open('small').load"),
    "missing data set": (lambda: verify("missing"), "no such folder"),
    "method of tiling": (lambda: load_material("rock", "mirro"), "mirror"),
    "arguments swapped": (lambda: fit("shards", FitConfig(), "out"), "FitConfig("),
    "one folder of several": (lambda: fit_jointly(FitConfig(), "a", "b"), "list of folders"),
    "no material": (lambda: Material.load(None), "path"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_one_line_and_a_hint(
    mistake: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    make, expected = MISTAKES[mistake]
    with pytest.raises(mbtf_gen.MbtfError) as fault:
        make()
    assert expected in fault.value.message
    assert len(fault.value.message.splitlines()) <= 2


def test_paths_are_taken_where_names_are(tmp_path: Path) -> None:
    assert GeneratorConfig(material=tmp_path).material == str(tmp_path)
    assert FitConfig(decoder=tmp_path).decoder == str(tmp_path)


def test_notebooks_complete_the_public_names() -> None:
    assert {"GeneratorConfig", "generate"} <= set(dir(mbtf_gen))
    assert {"FitConfig", "fit"} <= set(dir(mbtf_fit))
