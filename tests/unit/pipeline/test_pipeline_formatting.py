"""What cannot be told from zero is printed as such, with its error bar."""

from __future__ import annotations

import math

import pytest

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.perceptual_metrics import MEASURES, measured, visible_text
from mbtf_pipeline.formatting import data_errors, decibel, error_text, levels, percent


@pytest.mark.parametrize("value", [0.03, -0.03, 0.0])
def test_a_value_below_its_bar_is_called_that(value: float) -> None:
    text = error_text(Estimate(value, 0.02, 100))
    assert text.startswith("below two error bars (")
    assert "± 0.02" in text


def test_a_value_above_its_bar_is_just_printed() -> None:
    assert error_text(Estimate(0.123, 0.004, 100), 100.0, " %") == "12.3 ± 0.4 %"
    assert error_text(Estimate(-0.123, 0.004, 100)) == "−0.123 ± 0.004"
    assert percent(Estimate(math.nan, math.inf, 1)) == "not defined"


def test_both_errors_of_the_same_queries_are_told_from_zero_or_neither() -> None:
    close, clear = {"value": 0.1, "error": 0.051, "n": 9}, {"value": 1e-4, "error": 4.9e-5, "n": 9}
    for unexplained, mse in ((close, clear), (clear, close), (close, close)):
        texts = data_errors({"unexplained": unexplained, "mse": mse})
        assert all(text.startswith("below two error bars (") for text in texts)
    assert data_errors({"unexplained": clear, "mse": clear}) == ("0.010 ± 0.005 %", "0.10 ± 0.05")


def test_no_decibels_for_an_error_that_may_be_none() -> None:
    mse = {"value": 1e-4, "error": 1e-6, "n": 9}
    psnr = {"value": 40.0, "error": 0.2, "n": 9}
    assert decibel(psnr, mse) == "40.0 ± 0.2 dB"
    assert decibel({**psnr, "value": -3.0}, mse) == "−3.0 ± 0.2 dB"
    assert decibel(psnr, {**mse, "error": 1e-4}).startswith("error below two error bars")
    assert (
        decibel({"value": None, "error": None, "n": 9}, {**mse, "value": -1e-4})
        == "error below two error bars"
    )


def test_visible_differences_that_noise_explains() -> None:
    hdr, ssim, learned = MEASURES[1], MEASURES[2], MEASURES[3]
    noise = {"flip": {"hdr": 0.1}, "ssim": 0.9, "st_lpips": None}
    close = {"flip": {"hdr": 0.09}, "ssim": 0.93, "st_lpips": None}
    far = {"flip": {"hdr": 0.2}, "ssim": 0.8, "st_lpips": None}
    texts = [visible_text(hdr, record, noise) for record in (close, far)]
    assert texts == ["0.090, not above noise alone (0.100)", "0.200"]
    # The larger SSIM is the smaller difference.
    texts = [visible_text(ssim, record, noise) for record in (close, far)]
    assert texts == ["0.930, not above noise alone (0.900)", "0.800"]
    assert visible_text(learned, far, noise) == "–"
    assert [m.title for m in measured([{"fits": {"a": far}}], ["a"])] == ["HDR-FLIP", "SSIM"]


def test_levels_finer_than_the_data_are_named() -> None:
    assert levels([3.0, 3.0], 7) == "level 3.0"
    assert levels([6.0, 8.5], 7) == "level 6.0–8.5 (finest of the data 7)"
