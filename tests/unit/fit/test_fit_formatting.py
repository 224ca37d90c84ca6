"""Summary of errors, and remarks beside their table."""

from __future__ import annotations

from typing import Any

import pytest

from mbtf_fit.formatting import VISIBILITY, describe_errors, report_errors, summarize_errors, visibility


def errors(value: float | None, by_level: float | None) -> dict[str, Any]:
    def group(unexplained: float | None) -> dict[str, Any]:
        error = None if unexplained is None else 0.1
        return {"n": 100, "unexplained": {"value": unexplained, "error": error}}

    return {"test": group(value) | {"levels": {"0": group(by_level)}, "elevations": {}}}


@pytest.mark.parametrize(
    ("value", "by_level", "remarks"),
    [
        (0.3, 0.2, []),
        (0.3, None, ["undefined unexplained variance: the noise exceeds"]),
        (1.0, 0.2, ["above 1: worse than the mean value"]),
        (0.99, 7.0, []),
        (None, None, ["undefined unexplained variance: the noise exceeds"]),
        (
            127.0,
            None,
            ["undefined unexplained variance: the noise exceeds", "above 1: worse than the mean value"],
        ),
    ],
)
def test_bad_errors_are_explained(value: float | None, by_level: float | None, remarks: list[str]) -> None:
    lines = describe_errors(errors(value, by_level))
    assert lines[3].split() == ["queries", "100"]
    assert len(lines) == 4 + len(remarks)
    for line, remark in zip(lines[4:], remarks, strict=True):
        assert line.startswith(remark)


def test_advice_for_measured_data_names_their_options() -> None:
    found = errors(1.5, None)
    found["test"]["includes_noise"] = True
    remarks = " ".join(describe_errors(found)[4:])
    assert "these values do not vary" in remarks
    assert "mbtf-gen import --queries" in remarks
    assert "--spp" not in remarks


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
        (0.0, 5e-4, "PSNR above 30.0 dB", "at most visible"),
        (0.0, 0.0, "PSNR infinite", "not visible"),
    ],
)
def test_psnr_has_a_word(mse: float, error: float, text: str, word: str) -> None:
    assert visibility(split(mse, error)) == (text, word)
    # Four times the value is two stops less exposure, and the same picture.
    assert visibility(split(16 * mse, 16 * error) | {"exposure": -2.0}) == (text, word)
    assert [least for least, _ in VISIBILITY] == sorted((least for least, _ in VISIBILITY), reverse=True)


def test_the_summary_has_one_number_of_one_split() -> None:
    found = {
        "held_out_queries": split(2e-3, 1e-5, 0.2),
        "training": split(1e-3, 1e-5, 0.1),
        "test": split(1e-3, 1e-5),
    }
    lines = summarize_errors(found)
    assert lines == [
        "unexplained variance 0.160 ± 0.003 of 4096 test queries (0: exact, 1: as good as the mean value)",
        "PSNR 30.0 dB at exposure +0.00 EV (1 1/sr is white): visible beside the reference",
        "held-out queries 0.200 ± 0.003, training queries 0.100 ± 0.003",
    ]
    assert report_errors(found, None) == lines
    assert report_errors(found, None, verbose=True) == [*lines, *describe_errors(found)]
    del found["test"]
    assert summarize_errors(found)[0].startswith(
        "unexplained variance 0.200 ± 0.003 of 4096 held-out queries"
    )


def test_where_the_unexplained_variance_is_undefined_the_psnr_is_the_number() -> None:
    """A material of one value, or few noisy queries."""
    lines = summarize_errors({"test": split(1e-5, 1e-6, None), "training": split(1e-5, 1e-6, None)})
    assert lines[0].startswith("PSNR 50.0 dB of 4096 test queries at exposure +0.00 EV")
    assert lines[-1].startswith("undefined unexplained variance: the noise exceeds")


def test_errors_on_the_data_of_another_material_give_no_advice_about_queries() -> None:
    assert len(describe_errors(errors(1.5, 0.4), foreign=True)) == 4
