"""Pilots: seconds per unit of work, their error, and what is announced."""

from __future__ import annotations

import pytest

from mbtf_core import forecast as module
from mbtf_core.forecast import FEWEST_PIECES, pilot_seconds, processor_share
from mbtf_core.run.task import THREADS_VARIABLE, available_cores


class Clock:
    """Time that passes only where work is done."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


def test_a_pilot_times_its_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)

    def piece(number: int) -> float:
        # One piece is slowed down by other work.
        clock.now += 2.0 * number * (10.0 if number == 2 else 1.0)
        return 4.0 * number

    assert pilot_seconds(piece, 0.0).n == FEWEST_PIECES
    found = pilot_seconds(piece, 100.0)
    assert found.value == pytest.approx(0.5)
    assert found.error < 0.01


def test_threads_that_share_a_processor_get_less_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, str(8 * available_cores()))
    assert 0 < processor_share() < 0.5
