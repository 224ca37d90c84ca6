"""Summary of errors, and remarks beside their table."""

from __future__ import annotations

from typing import Any

import pytest

from mbtf_fit.formatting import VISIBILITY, report_errors, visibility


def split(mse: float, error: float, unexplained: float | None = 0.16) -> dict[str, Any]:
    """At 0 EV, white is 1."""
    return {
        "n": 4096,
        "mse": {"value": mse, "error": error},
        "unexplained": {"value": unexplained, "error": None if unexplained is None else 0.003},
        "exposure": 0.0,
        "levels": {},
        "elevations": {},
    }


@pytest.mark.parametrize(
    ("mse", "error", "text", "word"),
    [
        (1e-5, 1e-7, "PSNR 50.0 dB", "not visible"),
        (2e-4, 1e-6, "PSNR 37.0 dB", "barely visible"),
        (1e-3, 1e-5, "PSNR 30.0 dB", "visible"),
        (1e-2, 1e-4, "PSNR 20.0 dB", "clearly visible"),
        # An error below its own uncertainty, which may be negative.
        (-1e-5, 2e-5, "PSNR above 45.2 dB", "not visible"),
        (0.0, 5e-4, "PSNR above 30.0 dB", "visible at most"),
        # A bound that excludes nothing.
        (0.0, 250.0, "PSNR unknown", None),
        (0.0, 0.0, "PSNR infinite", "not visible"),
    ],
)
def test_psnr_has_a_word(mse: float, error: float, text: str, word: str | None) -> None:
    assert visibility(split(mse, error)) == (text, word)
    # Four times the value is two stops less exposure, and the same picture.
    assert visibility(split(16 * mse, 16 * error) | {"exposure": -2.0}) == (text, word)
    assert [least for least, _ in VISIBILITY] == sorted((least for least, _ in VISIBILITY), reverse=True)


@pytest.mark.parametrize(("value", "remark"), [(0.99, False), (1.0, False), (1.2, True)])
def test_errors_above_1_are_worse_than_the_mean_value(value: float, remark: bool) -> None:
    found = {"test": split(1e-3, 1e-5, value)}
    assert ("above 1: worse than the mean value" in report_errors(found, None)[-1]) == remark
    # The data of another material say nothing of the number of queries.
    assert "above 1" not in report_errors(found, None, foreign=True)[-1]
