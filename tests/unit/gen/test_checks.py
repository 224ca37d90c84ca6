"""Checks of doctor and self-test: verdicts, hints, and that every check of the physics can fail."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable

import pytest

from mbtf_core.app.console import Console
from mbtf_core.errors import EngineError
from mbtf_gen.diagnostics import selftest
from mbtf_gen.diagnostics.checks import Absent, Check, report_checks, run_check
from mbtf_gen.diagnostics.selftest import Case, verdict


@pytest.mark.parametrize(
    ("off", "error", "good"),
    [
        (9e-4, 0.0, True),
        (-1.1e-3, 0.0, False),
        (-5.4e-3, 1e-3, True),
        (5.6e-3, 1e-3, False),
        (math.nan, 1.0, False),
        (0.0, math.inf, False),
    ],
)
def test_a_case_may_be_off_by_tolerance_and_noise(off: float, error: float, good: bool) -> None:
    with contextlib.nullcontext() if good else pytest.raises(EngineError, match="other; 2 cases"):
        verdict(1e-3, {"right": Case(0.0), "other": Case(off, error)})


@pytest.mark.parametrize("required", [True, False])
def test_only_required_checks_fail_the_installation(
    required: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(error: Exception) -> str:
        raise error

    broken = Check("broken", lambda: fails(RuntimeError("drjit: no memory\nleft")), required, "free some")
    checks = [Check("right", lambda: "3.11"), Check("CUDA", lambda: fails(Absent("no GPU"))), broken]
    assert report_checks(checks, Console(json=True), workers=2) == (3 if required else 0)
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] is not required
    assert [(c["state"], c["found"]) for c in found["checks"]] == [
        ("ok", "3.11"),
        ("absent", "no GPU"),
        ("failed", "drjit: no memory left"),
    ]


# That all checks pass is seen by the system test, which runs them all.
@pytest.mark.parametrize("name", ["Lambert plane", "V-groove", "furnace", "surface energy"])
def test_checks_of_the_physics_can_fail(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three percent of albedo too little."""
    right: Callable[[float], object] = selftest._diffuse
    monkeypatch.setattr(selftest, "_diffuse", lambda albedo: right(0.97 * albedo))
    (check,) = (check for check in selftest.all_checks() if check.name == name)
    assert run_check(check).state == "failed"
