"""Pilots: seconds per unit of work, their error, and what is announced."""

from __future__ import annotations

import pytest

from mbtf_core import forecast as module
from mbtf_core.forecast import FEWEST_PIECES, pilot_seconds


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
