"""The configuration that the options of ``mbtf-fit`` give."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.app.console import run
from mbtf_core.config.settings import build
from mbtf_core.errors import InputError, UsageError
from mbtf_core.units import format_duration, parse_duration
from mbtf_fit.cli.app import app
from mbtf_fit.cli.fit import FitOptions, resolve_config
from mbtf_fit.config import FitConfig
from mbtf_fit.sections import TimeBudget


def config_of(*words: str) -> FitConfig:
    _, bound, _ = app.parse_args(["shards", *words], exit_on_error=False, print_error=False)
    arguments = dict(bound.arguments)
    return resolve_config(arguments.get("options", FitOptions()), arguments.get("quality"), Path("shards"))


def test_flags_override_assignments_presets_and_files(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    file.write_text("model: neumip-baseline\ntraining: {steps: 9, batch: 300, warmup: 7}\n")
    words = ("--config", str(file), "--set", "training.batch=400")
    found = config_of(*words, "--set", "training.steps=8", "--steps", "2")
    assert found.model == "neumip-baseline"
    assert (found.training.steps, found.training.batch, found.training.warmup) == (2, 400, 7)
    for time in (("--time", "1min"), ("--set", "training.time=1min"), ("--set", "training={time: 1min}")):
        found = config_of(*words, *time)
        assert (found.training.steps, found.training.time) == (None, TimeBudget(60.0))
    found = config_of("--quality", "draft", "--set", "training={steps: 3}")
    assert found.training.steps == 3
    found = config_of("--quality", "paper", "--batch", "500")
    assert (found.training.steps, found.training.batch, found.network.width) == (30_000, 500, 64)


def test_a_time_and_a_number_of_steps_exclude_each_other() -> None:
    for words in (("--time", "1min", "--steps", "3"), ("--set", "training={time: 1min, steps: 3}")):
        with pytest.raises(UsageError, match=r"time.* and .*steps'? are mutually exclusive"):
            config_of(*words)


def test_presets_keep_what_sections_set() -> None:
    single = config_of("--quality", "draft", "--set", "training.batch=50")
    assert config_of("--quality", "draft", "--set", "training={batch: 50}") == single
    assert (single.training.time, single.network.width) == (TimeBudget(12.0, 800), 40)
    # An explicit time is the time, also in place of a preset number of steps.
    for words in (("--time", "5s"), ("--set", "training={time: 5s}")):
        assert config_of("--quality", "draft", *words).training.time == TimeBudget(5.0)
        training = config_of("--quality", "paper", *words).training
        assert (training.time, training.steps) == (TimeBudget(5.0), None)


def test_durations_are_read() -> None:
    known = {"90s": 90.0, "2min": 120.0, "2 m": 120.0, "1.5h": 5400.0, 45: 45.0, "0.5s": 0.5}
    for text, seconds in known.items():
        assert parse_duration(text) == seconds
        assert parse_duration(format_duration(seconds)) == seconds
    for budget in (TimeBudget(90.0), TimeBudget(0.5, 3)):
        assert TimeBudget.parse(str(budget)) == budget
    with pytest.raises(ValueError, match="must be a duration"):
        TimeBudget.parse("90s or so")


def test_hash_covers_data_and_options_but_not_the_device() -> None:
    config = FitConfig()
    assert config.hash("data") == FitConfig(device="cpu").hash("data")
    assert config.hash("data") != config.hash("other data")
    assert config.hash("data") != FitConfig(seed=1).hash("data")
    assert config.hash("data") == FitConfig.model_validate({"training": {"time": "120s"}}).hash("data")


def test_a_held_out_direction_lies_on_the_disk() -> None:
    with pytest.raises(InputError, match="within the unit disk"):
        FitConfig.model_validate({"held_out": {"direction": (0.8, -0.7)}})


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "no shards given"),
        ("a --many b", "--many replaces the argument SHARDS"),
        ("a --cluster local", "--cluster requires --many"),
    ],
)
def test_one_fit_and_several_have_options_of_their_own(
    line: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(app, line.split()) == 2
    assert message in capsys.readouterr().err


def test_a_model_that_is_not_installed_is_named() -> None:
    with pytest.raises(InputError, match="'texel-lobe'"):
        build(FitConfig, {"model": "texel-lobe"}, source="material.json")
