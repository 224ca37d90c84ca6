"""The exposure rule of all pictures."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core.color import (
    ALBEDO_EXPOSURE,
    auto_exposure,
    brightness,
    chosen_exposure,
    srgb_to_linear,
    to_display,
    white_of,
)

RAMP = np.repeat(np.linspace(0, 1, 1001)[:, None], 3, axis=1).reshape(-1, 1, 3)


def test_the_automatic_exposure_shows_bright_values_as_four_fifths_of_white() -> None:
    for pictures, level in (([RAMP], 0.95), ([RAMP, 100 * RAMP, 3 * RAMP], 2.85)):
        found = auto_exposure(map(brightness, pictures))
        assert white_of(found) == pytest.approx(level / 0.8, rel=0.004)
    assert auto_exposure([brightness(0 * RAMP)]) == 0.0


def test_the_default_exposure_keeps_albedos() -> None:
    """Lambert: albedo/π under unit irradiance."""
    for albedo in (0.03, 0.5, 0.9):
        shown = to_display(np.full(3, albedo / np.pi), chosen_exposure(ALBEDO_EXPOSURE, [7.0]))
        np.testing.assert_allclose(srgb_to_linear(shown / 255), albedo, rtol=0.02)


def test_a_stop_is_a_factor_of_two() -> None:
    np.testing.assert_array_equal(to_display(RAMP, 1.0), to_display(2 * RAMP, 0.0))
    assert to_display(np.array([[0.0, 0.25, 9.0]]), 2.0).tolist() == [[0, 255, 255]]
