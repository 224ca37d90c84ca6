"""Checks of doctor and self-test: verdicts, means over rounds, hints, and that every check can fail."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping

import pytest

from mbtf_core.app.console import Console
from mbtf_gen import selftest
from mbtf_gen.checks import Check, Finding, report, run_checks
from mbtf_gen.selftest import Case, KnownAnswer


def compared(cases: Mapping[str, Case], tolerance: float = 1e-3) -> Finding:
    return KnownAnswer(tolerance, lambda _: cases)(0)


@pytest.mark.parametrize(
    ("off", "error", "state"),
    [
        (9e-4, 0.0, "ok"),
        (-1.1e-3, 0.0, "failed"),
        (-5.4e-3, 1e-3, "ok"),
        (5.6e-3, 1e-3, "failed"),
        (math.nan, 1.0, "failed"),
        (0.0, math.inf, "failed"),
    ],
)
def test_a_case_may_be_off_by_tolerance_and_noise(off: float, error: float, state: str) -> None:
    assert compared({"right": Case(0.0), "other": Case(off, error)}).state == state


@pytest.mark.parametrize("required", [True, False])
def test_only_required_checks_fail_the_installation(
    required: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: int) -> Finding:
        raise RuntimeError("drjit: no memory\nleft")

    checks = [Check("right", lambda _: Finding("ok", "3.11")), Check("broken", broken, required, "free some")]
    run_checks(checks, workers=2)
    assert report(checks, Console(json=True)) == (3 if required else 0)
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] is not required
    assert [(c["state"], c["found"]) for c in found["checks"]] == [
        ("ok", "3.11"),
        ("failed", "drjit: no memory left"),
    ]


# That all checks pass is seen by the system test, which runs them all.
@pytest.mark.parametrize("name", ["Lambert plane", "V-groove", "furnace", "surface energy"])
def test_checks_of_the_physics_can_fail(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three percent of albedo too little."""
    right: Callable[[float], object] = selftest._diffuse
    monkeypatch.setattr(selftest, "_diffuse", lambda albedo: right(0.97 * albedo))
    (check,) = (check for check in selftest.all_checks() if check.name == name)
    check.run_round()
    assert check.finding.state == "failed"
