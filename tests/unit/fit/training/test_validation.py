"""The validation error in the progress line."""

from __future__ import annotations

import pytest

from mbtf_fit.training.validation import describe_record


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.25, 0.01, ", validation error 0.250 ± 0.010, "),
        (0.25, None, ", validation error 0.250 ± ?, "),
        (None, None, "0, 2"),
    ],
)
def test_unknown_errors_are_question_marks(value: float | None, error: float | None, text: str) -> None:
    record = {"loss": 0.5, "unexplained": value, "unexplained_error": error, "queries_per_second": 2_000_000}
    assert text in describe_record(record)
