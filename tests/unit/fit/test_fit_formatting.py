"""Remarks beside the table of errors."""

from __future__ import annotations

from typing import Any

import pytest

from mbtf_fit.formatting import describe_errors


def errors(value: float | None, by_level: float | None) -> dict[str, Any]:
    def group(unexplained: float | None) -> dict[str, Any]:
        error = None if unexplained is None else 0.1
        return {"n": 100, "unexplained": {"value": unexplained, "error": error}}

    return {"test": group(value) | {"levels": {"0": group(by_level)}, "elevations": {}}}


@pytest.mark.parametrize(
    ("value", "by_level", "remarks"),
    [
        (0.3, 0.2, []),
        (0.3, None, ["undefined: the noise exceeds"]),
        (1.0, 0.2, ["above 1: worse than the mean value"]),
        (0.99, 7.0, []),
        (None, None, ["undefined: the noise exceeds"]),
        (127.0, None, ["undefined: the noise exceeds", "above 1: worse than the mean value"]),
    ],
)
def test_bad_errors_are_explained(value: float | None, by_level: float | None, remarks: list[str]) -> None:
    lines = describe_errors(errors(value, by_level))
    assert lines[3].split() == ["queries", "100"]
    assert len(lines) == 4 + len(remarks)
    for line, remark in zip(lines[4:], remarks, strict=True):
        assert line.startswith(remark)


def test_errors_on_the_data_of_another_material_give_no_advice_about_queries() -> None:
    assert len(describe_errors(errors(1.5, 0.4), foreign=True)) == 4
