"""The share of the processors that other work leaves."""

from __future__ import annotations

import pytest

from mbtf_core.forecast import processor_share
from mbtf_core.run.task import THREADS_VARIABLE, available_cores


def test_threads_that_share_a_processor_get_less_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(THREADS_VARIABLE, str(8 * available_cores()))
    assert 0 < processor_share() < 0.5
