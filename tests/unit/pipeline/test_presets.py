"""Qualities lie over files and under everything that is said explicitly."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import get_args

import pytest
from support.paths import ROOT

from mbtf_core.config_file import resolve
from mbtf_fit.config import FitConfig
from mbtf_fit.presets import FITTER, best_at, best_options, fitter_options, overrides_of
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.config.presets import GENERATOR, Quality, as_assignments
from mbtf_gen.config.quality_measured import Expected, PresetRun, expected, markdown_table, read_expected
from mbtf_pipeline.presets import COMPARE, quality_assignments, settings_hash
from mbtf_pipeline.recipe import load_recipe

QUALITIES: tuple[Quality, ...] = get_args(Quality)


def test_every_program_has_every_quality() -> None:
    assert list(GENERATOR) == list(FITTER) == list(COMPARE) == list(QUALITIES)


def test_each_quality_takes_more_paths_than_the_one_before() -> None:
    paths = []
    for quality in QUALITIES:
        config = resolve(GeneratorConfig, assignments=["material=m", *as_assignments(GENERATOR[quality])])
        paths.append(count_queries(config.queries.train, 128**2) * config.queries.spp)
    assert paths == sorted(paths)
    assert len(set(paths)) == len(paths)
    # The bars of test errors, which are free of noise, hang on the number of queries.
    tests = [int(GENERATOR[q]["queries.test"]) for q in QUALITIES]
    assert tests == sorted(tests)


@pytest.mark.parametrize("quality", QUALITIES)
@pytest.mark.parametrize("name", ["quickstart", "ci"])
def test_recipes_take_a_quality(quality: Quality, name: str) -> None:
    path = ROOT / "pipelines" / f"{name}.yaml"
    recipe = load_recipe(path, quality_assignments(path, quality))
    assert recipe.generate.queries.train == GENERATOR[quality]["queries.train"]
    # What a quality does not speak of stays the recipe's.
    plain = load_recipe(path)
    assert recipe.generate.light == plain.generate.light
    assert list(recipe.fit) == list(plain.fit)
    for fit in recipe.fit.values():
        expected = resolve(FitConfig, assignments=as_assignments(FITTER[quality]))
        assert fit.training.steps == expected.training.steps
        if expected.training.steps is None:
            assert fit.training.time == expected.training.time
    assert recipe.compare.size == COMPARE[quality]["compare.size"]


@pytest.mark.parametrize("name", ["models", "hierarchical"])
@pytest.mark.parametrize("quality", QUALITIES)
def test_recipes_that_compare_networks_keep_them(quality: Quality, name: str) -> None:
    path = ROOT / "pipelines" / f"{name}.yaml"
    plain, raised = load_recipe(path), load_recipe(path, quality_assignments(path, quality))
    assert {n: f.network for n, f in raised.fit.items()} == {n: f.network for n, f in plain.fit.items()}
    for one, fit in raised.fit.items():
        if plain.fit[one].training.blur.start == 0 or fit.model == "hierarchical":
            assert fit.training.blur == plain.fit[one].training.blur


def test_other_recipes_get_the_network_of_the_qualities() -> None:
    path = ROOT / "pipelines" / "rock_cliff.yaml"
    fits = {"neumip": {"model": "neumip"}, "neumip-baseline": {"model": "neumip-baseline"}}
    assert {n: {**best_at("draft"), **FITTER["draft"]} for n in fits} == fitter_options("draft", fits)
    fits["hierarchical"] = {"model": "hierarchical"}
    assert fitter_options("draft", fits)["hierarchical"] == FITTER["draft"]
    text = quality_assignments(path, "draft")
    assert {"fit.neumip.network.width=40", "fit.neumip-baseline.training.decay=1.0"} <= set(text)
    # What the command line says of a network, or of smoothing, is not mixed with it.
    text = quality_assignments(path, "draft", ["fit.neumip.network.width=25", "fit.neumip.training.decay=0"])
    assert not any("network" in t or t.startswith("fit.neumip.training.decay") for t in text)
    assert "fit.neumip.training.blur.floor=0.8" in text


def test_longer_training_gets_a_larger_network() -> None:
    widths = [best_options(seconds)["network.width"] for seconds in (1.0, 20.0, 600.0, math.inf)]
    assert widths == sorted(widths)
    assert widths[0] < widths[-1]
    # A quality's is that of its time; steps of a size that only a GPU takes are the longest.
    assert best_at("draft") == best_options(20.0)
    assert best_at("high") == best_options(600.0) == best_at("paper")
    known = {"high": "network.width=64", "draft": "network.width=40"}
    for quality, text in known.items():
        assert f"fit.neumip.{text}" in quality_assignments(ROOT / "pipelines" / "rock_cliff.yaml", quality)


def test_a_file_of_the_fitter_stands(tmp_path: Path) -> None:
    file = tmp_path / "fit.yaml"
    file.write_text("network: {channels: 5}\ntraining: {blur: {start: 4}}\n")
    said = {"model": "neumip", **overrides_of(file, ["seed=3"])}
    assert fitter_options("draft", {"": said})[""] == {"training.decay": 1.0, **FITTER["draft"]}
    said = {"model": "neumip", **overrides_of(None, ["model=hierarchical"])}
    assert fitter_options("high", {"": said})[""] == FITTER["high"]


def test_what_is_said_explicitly_wins(tmp_path: Path) -> None:
    path = ROOT / "pipelines" / "quickstart.yaml"
    said = [*quality_assignments(path, "draft"), "generate.queries.train=5/texel"]
    assert load_recipe(path, said).generate.queries.train == "5/texel"
    file = tmp_path / "fit.yaml"
    file.write_text("training: {steps: 7}\n")
    resolved = resolve(FitConfig, file=file, assignments=as_assignments(FITTER["draft"]))
    assert resolved.training.steps is None
    assert resolved.training.time == 20


CHAINS = (
    PresetRun("rock", "draft", 0.1, 41.0, 5.0, 20.0, 0.314, 0.01, 10**8, 10**6, 3e6, "h"),
    PresetRun("bark", "draft", None, 52.4, 6.0, 20.0, 0.62, 0.02, 10**8, 10**6, 3e6, "h"),
    PresetRun("rock", "high", 0.1, 1800.0, 300.0, 1200.0, 0.05, 0.002, 10**9, 10**6, 3e6, "h"),
)
# From which the last is extrapolated; not what the quality reaches.
QUARTER = PresetRun("rock", "high", 0.1, 700.0, 300.0, 300.0, 0.08, 0.002, 10**9, 10**6, 3e6, "h", 0.25)
GUESS = PresetRun("rock", "paper", 0.1, 40000.0, 20000.0, 20000.0, 0.03, 0.0, 10**9, 10**6, 3e6, "h")


def written(folder: Path, chains: tuple[PresetRun, ...], guesses: tuple[PresetRun, ...]) -> Expected:
    """Figures as the benchmark writes them, read back."""
    path = folder / "figures.json"
    head = {
        "date": "2001-02-03",
        "machine": "a machine",
        "command": "c",
        "resolution": 128,
        "law": "as it comes",
    }
    rows = {"runs": [asdict(c) for c in chains], "extrapolated": [asdict(c) for c in guesses]}
    path.write_text(json.dumps({**head, **rows}))
    return read_expected(path)


def test_measured_qualities_are_told_from_guessed_ones(tmp_path: Path) -> None:
    found = written(tmp_path, (*CHAINS, QUARTER), (GUESS,))
    assert found.line("draft") == "draft 0:41 to 0:52 in all, 0.31 to 0.62 unexplained"
    assert found.line("high") == "high 30:00 in all, 0.05 unexplained"
    assert found.line("paper") == "paper 11:06:40 in all, 0.03 unexplained (extrapolated)"
    assert found.line("standard") is None
    rows = markdown_table(found, QUALITIES).splitlines()
    assert rows[-1] == "as it comes."
    assert [row.split(" | ")[0] for row in rows[2:-2]] == [
        "| `draft`", "| `draft`", "| `high`", "| `paper`, extrapolated",
    ]  # fmt: skip
    assert "rock, height scale 0.1 | 0:41 | 0:05 | 0:20 | 0.314 ± 0.010 | 100 MB | 1.00 MB |" in rows[2]
    assert "| bark |" in rows[3]


def test_figures_are_of_the_qualities_as_they_are() -> None:
    found = expected()
    assert found.runs
    for chain in (*found.runs, *found.extrapolated):
        assert chain.settings == settings_hash(chain.quality), f"{chain.material} {chain.quality}"  # type: ignore[arg-type]


def test_no_quality_changes_nothing() -> None:
    assert quality_assignments(ROOT / "pipelines" / "quickstart.yaml", None) == []
