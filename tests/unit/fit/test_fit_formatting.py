"""Summary of errors, and remarks beside their table."""

from __future__ import annotations

import pytest

from mbtf_fit.formatting import visibility


@pytest.mark.parametrize(
    ("mse", "error", "text", "word"),
    [
        (1e-5, 1e-7, "PSNR 50.0 dB", "not visible"),
        (1e-3, 1e-5, "PSNR 30.0 dB", "visible"),
        # An error below its own uncertainty, which may be negative.
        (-1e-5, 2e-5, "PSNR above 45.2 dB", "not visible"),
        (0.0, 5e-4, "PSNR above 30.0 dB", "visible at most"),
        # A bound that excludes nothing.
        (0.0, 250.0, "PSNR unknown", None),
        (0.0, 0.0, "PSNR infinite", "not visible"),
    ],
)
def test_psnr_has_a_word(mse: float, error: float, text: str, word: str | None) -> None:
    # Four times the value is two stops less exposure, and the same picture.
    for factor, exposure in ((1, 0.0), (16, -2.0)):
        errors = {"value": factor * mse, "error": factor * error}
        assert visibility({"mse": errors, "exposure": exposure}) == (text, word)
