"""Measurements of cost studies that take no time."""

from __future__ import annotations

import pytest

from mbtf_pipeline.cost import measurement


@pytest.fixture(autouse=True)
def free_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """No probe of the processors: this machine gets all of them."""
    monkeypatch.setattr(measurement, "processor_share", lambda: 1.0)
