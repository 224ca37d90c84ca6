"""Sizes of launches: small ones first, so that progress shows early, and large ones on fast machines."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbtf_gen.engine.runtime import load_mitsuba

load_mitsuba()

from mbtf_gen.render import estimator as module  # noqa: E402


@pytest.mark.parametrize("lights", [1, 4])
@pytest.mark.parametrize(("rate", "largest", "longest"), [(5e6, 1 << 20, 1.0), (2e4, 1 << 16, 8.0)])
def test_launches_grow_until_one_takes_seconds(
    monkeypatch: pytest.MonkeyPatch, rate: float, largest: int, longest: float, lights: int
) -> None:
    """The size of a launch counts each path once per light."""
    clock: Any = SimpleNamespace(now=0.0, perf_counter=lambda: clock.now)
    monkeypatch.setattr(module, "time", clock)
    observed: list[int] = []
    estimator: Any = SimpleNamespace(launch=1 << 20, _size=module.FIRST_LAUNCH, observe=observed.append)
    counts = np.full(1 << 19, 8, np.int64)
    queries = 0
    for rows in module.Estimator._launches(estimator, counts, lights):
        assert rows.start == queries
        queries = rows.stop
        clock.now += 8 * lights * (rows.stop - rows.start) / rate
    assert queries == len(counts)
    assert sum(observed) == counts.sum()
    assert (lights * observed[0], lights * max(observed)) == (module.FIRST_LAUNCH, largest)
    assert lights * max(observed) / rate < longest
    # Another process begins to use the machine.
    for rows in module.Estimator._launches(estimator, counts, lights):
        clock.now += 8 * lights * (rows.stop - rows.start) / 1e3
    assert lights * observed[-2] == module.FIRST_LAUNCH
