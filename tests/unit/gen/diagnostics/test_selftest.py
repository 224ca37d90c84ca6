"""The self-test: verdicts, means over rounds, and that every check can fail."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from mbtf_gen.diagnostics import selftest
from mbtf_gen.diagnostics.selftest import Case, Check, all_checks, as_text, exit_code, run_checks


def check(measure: Any = lambda number: None, **options: Any) -> Check:
    return Check("groove", "it holds", 1e-3, measure, **options)


@pytest.mark.parametrize(
    ("off", "error", "state"),
    [
        (9e-4, 0.0, "ok"),
        (-1.1e-3, 0.0, "failed"),
        (-5.4e-3, 1e-3, "ok"),
        (5.6e-3, 1e-3, "failed"),
        (math.nan, 1.0, "failed"),
        (math.inf, 0.0, "failed"),
        (0.0, math.inf, "failed"),
    ],
)
def test_a_case_may_be_off_by_tolerance_and_noise(off: float, error: float, state: str) -> None:
    cases = {"right": Case(0.0), "other": Case(off, error)}
    assert check(cases=cases).state == state
    assert exit_code([check(cases=cases)]) == (0 if state == "ok" else 3)
    assert exit_code([check(cases=cases, required=False)]) == 0


def test_the_worst_case_is_the_one_closest_to_its_limit() -> None:
    """Not the one with the largest error."""
    worst = check(cases={"noisy": Case(4e-3, 1e-2), "close": Case(-9e-4)}).worst
    assert worst is not None
    assert worst[0] == "close"


def test_rounds_are_averaged_and_exact_or_absent_checks_run_once() -> None:
    rng = np.random.default_rng(0)
    asked: list[int] = []

    def measure(number: int) -> Mapping[str, Case]:
        asked.append(number)
        return {"case": Case(float(rng.normal(0.5, 0.1)), 0.1)}

    noisy, exact, absent = check(measure), check(lambda number: {"case": Case(0.0)}), check()
    run_checks([noisy, exact, absent], 0.05)
    n = noisy.rounds
    assert asked == list(range(n))
    assert noisy.cases["case"].error == pytest.approx(0.1 / math.sqrt(n))
    assert abs(noisy.cases["case"].off - 0.5) < 4 * 0.1 / math.sqrt(n)
    assert (exact.rounds, absent.rounds) == (1, 1)
    assert (exact.state, absent.state) == ("ok", "absent")


def test_a_check_that_breaks_is_a_finding() -> None:
    def broken(number: int) -> Mapping[str, Case]:
        raise RuntimeError("drjit: no memory\nleft")

    checks = [check(broken), check(lambda number: {"case": Case(0.0)})]
    run_checks(checks, 0.0)
    assert [c.state for c in checks] == ["failed", "ok"]
    assert "groove: drjit: no memory left" in as_text(checks)


# That all checks pass is seen by the system test, which runs them all.
@pytest.mark.parametrize("name", ["Lambert plane", "V-groove", "furnace", "surface energy"])
def test_checks_can_fail(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three percent of albedo too little."""
    right = selftest._diffuse
    monkeypatch.setattr(selftest, "_diffuse", lambda albedo: right(0.97 * albedo))
    (found,) = (c for c in all_checks() if c.name == name)
    found.run_round()
    assert (found.fault, found.state) == ("", "failed")
