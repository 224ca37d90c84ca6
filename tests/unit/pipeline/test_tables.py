"""Values that do not differ significantly from zero are marked and printed with their error bars."""

from __future__ import annotations

import math

from mbtf_core.stats import Estimate
from mbtf_pipeline.compare.perceptual_metrics import PERCEPTUAL_METRICS, available_metrics
from mbtf_pipeline.tables import data_errors, decibel


def test_each_error_of_the_same_queries_is_marked_by_its_own_bar() -> None:
    close, clear = {"value": 0.1, "error": 0.051, "n": 9}, {"value": 1e-4, "error": 4.9e-5, "n": 9}
    for unexplained, mse in ((close, clear), (clear, close), (close, close)):
        texts = data_errors({"unexplained": unexplained, "mse": mse})
        assert [text.startswith("not significant (") for text in texts] == [
            unexplained is close,
            mse is close,
        ]
    assert data_errors({"unexplained": clear, "mse": clear}) == ("(1.0 ± 0.5)e−04", "0.10 ± 0.05")


def test_an_unexplained_variance_that_says_nothing_has_no_number() -> None:
    noisy, mse = {"value": 4070.0, "error": 5000.0, "n": 9}, {"value": 1e-4, "error": 1e-6, "n": 9}
    assert data_errors({"unexplained": noisy, "mse": mse})[0] == "not significant"
    # That of a diverged fit is one.
    assert data_errors({"unexplained": {**noisy, "error": 50.0}, "mse": mse})[0] == "4070 ± 50"


def test_psnr_of_an_insignificant_error_is_marked() -> None:
    mse, psnr = Estimate(1e-4, 1e-6, 9), Estimate(40.0, 0.2, 9)
    assert decibel(psnr, mse) == "40.0 ± 0.2 dB"
    assert decibel(Estimate(-3.0, 0.2, 9), mse) == "−3.0 ± 0.2 dB"
    assert decibel(psnr, Estimate(1e-4, 1e-4, 9)) == "MSE not significant (40.0 ± 0.2 dB)"
    assert decibel(Estimate(math.inf, math.inf, 9), Estimate(-1e-4, 1e-6, 9)) == "MSE not significant"


def test_perceptual_differences_that_noise_explains() -> None:
    """A larger SSIM is a smaller difference."""
    _, hdr, ssim, learned = PERCEPTUAL_METRICS
    assert [ssim.text(value, 0.9) for value in (0.93, 0.8)] == ["0.930, within noise (0.900)", "0.800"]
    record = {"flip": {"hdr": 0.2}, "ssim": 0.8, "st_lpips": None}
    assert (hdr.of(record), learned.text(learned.of(record), None)) == (0.2, "–")
    assert [m.title for m in available_metrics([{"fits": {"a": record}}], ["a"])] == ["HDR-FLIP", "SSIM"]
