"""Configuration of the fitter."""

from __future__ import annotations

import pytest

from mbtf_core.units import format_duration, parse_duration
from mbtf_fit.config import FitConfig


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90.0), ("2min", 120.0), ("2 m", 120.0), ("1.5h", 5400.0), (45, 45.0), ("0.5s", 0.5)],
)
def test_durations_are_read(text: str | float, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize("seconds", [0.25, 45.0, 90.0, 120.0, 3600.0, 5400.0, 7261.0])
def test_durations_survive_writing(seconds: float) -> None:
    assert parse_duration(format_duration(seconds)) == seconds


def test_hash_covers_data_and_options_but_not_the_device() -> None:
    config = FitConfig()
    assert config.hash("data") == FitConfig(device="cpu").hash("data")
    assert config.hash("data") != config.hash("other data")
    assert config.hash("data") != FitConfig(seed=1).hash("data")
    assert config.hash("data") == FitConfig.model_validate({"training": {"time": "120s"}}).hash("data")


@pytest.mark.parametrize("direction", [(1.0, 2.0), (0.8, -0.7), (1.0, 0.0)])
def test_a_held_out_direction_lies_on_the_disk(direction: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="within the unit disk"):
        FitConfig.model_validate({"held_out": {"direction": direction}})
