"""Calls with a time limit."""

from __future__ import annotations

import threading

import pytest

from mbtf_core.timeouts import NoAnswer, call_within


def test_results_and_errors_are_those_of_the_call() -> None:
    assert call_within(60.0, lambda: 3) == 3
    with pytest.raises(ZeroDivisionError):
        call_within(60.0, lambda: 1 // 0)


def test_a_call_that_never_returns_is_given_up() -> None:
    never = threading.Event()
    with pytest.raises(NoAnswer, match="within 0 s"):
        call_within(0.01, never.wait)
    never.set()
