"""The self-test: verdicts, means over rounds, reports, and that every check can fail."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.data import shard_files
from mbtf_gen.diagnostics import checks as selftest_checks
from mbtf_gen.diagnostics import closed_forms
from mbtf_gen.diagnostics import report as selftest_report
from mbtf_gen.diagnostics.selftest import Case, Check, Finding, exit_code, run_checks
from mbtf_gen.sampling.light_kernel import LightKernel


def check(measure: Any, **options: Any) -> Check:
    return Check("groove", "it holds", 1e-3, measure, **options)


def found(*cases: Case, **options: Any) -> Finding:
    finding = Finding(check(lambda number: None, **options))
    finding.add({f"case {i}": c for i, c in enumerate(cases)})
    return finding


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
    assert found(Case(0.0), Case(off, error)).state == state
    assert exit_code([found(Case(off, error))]) == (0 if state == "ok" else 3)
    assert exit_code([found(Case(off, error), required=False)]) == 0


def test_the_worst_case_is_the_one_closest_to_its_limit() -> None:
    """Not the one with the largest error."""
    worst = found(Case(4e-3, 1e-2), Case(-9e-4)).worst
    assert worst is not None
    assert worst[0] == "case 1"


def test_rounds_are_averaged() -> None:
    rng = np.random.default_rng(0)
    asked: list[int] = []

    def measure(number: int) -> Mapping[str, Case]:
        asked.append(number)
        return {"case": Case(float(rng.normal(0.5, 0.1)), 0.1)}

    (finding,) = run_checks([check(measure)], 0.05)
    n = finding.rounds
    assert asked == list(range(n))
    assert finding.cases["case"].error == pytest.approx(0.1 / math.sqrt(n))
    assert abs(finding.cases["case"].off - 0.5) < 4 * 0.1 / math.sqrt(n)


def test_what_gains_nothing_runs_once_and_what_is_absent_is_no_failure() -> None:
    rounds: list[int] = []

    def once(number: int) -> Mapping[str, Case]:
        rounds.append(number)
        return {"case": Case(0.0)}

    findings = run_checks([check(once, repeated=False), check(lambda number: None)], 0.05)
    assert rounds == [0]
    assert [f.state for f in findings] == ["ok", "absent"]
    assert exit_code(findings) == 0


def test_a_check_that_breaks_is_a_finding() -> None:
    def broken(number: int) -> Mapping[str, Case]:
        raise RuntimeError("drjit: no memory\nleft")

    findings = run_checks([check(broken), check(lambda number: {"case": Case(0.0)})], 0.0)
    assert [f.state for f in findings] == ["failed", "ok"]
    text = selftest_report.as_text(findings)
    assert "groove: drjit: no memory left" in text
    assert text.endswith("failed: groove")
    assert json.loads(json.dumps(selftest_report.as_json(findings)))["ok"] is False


def halved(path: Path, arrays: Mapping[str, Any], write: Any = shard_files.write_shard) -> None:
    """A shard in half precision."""
    write(path, {k: v.astype(np.float16).astype(np.float32) for k, v in arrays.items()})


def dimmed(albedo: float, right: Any = selftest_checks._diffuse) -> dict[str, Any]:
    """Three percent of albedo too little."""
    return right(0.97 * albedo)


# That all checks pass is seen by the system test, which runs them all.
@pytest.mark.parametrize(
    ("name", "owner", "attribute", "wrong"),
    [
        *(
            (name, selftest_checks, "_diffuse", dimmed)
            for name in ("Lambert plane", "V-groove", "wall", "furnace", "surface energy")
        ),
        ("mirror", selftest_checks, "mirror", lambda *a: 1.03 * closed_forms.mirror(*a)),
        # An irradiance without the horizon.
        ("irradiance", LightKernel, "irradiance", lambda self, omega: np.asarray(omega, np.float64)[..., 2]),
        ("directions", shard_files, "write_shard", halved),
    ],
)
def test_checks_can_fail(
    name: str, owner: Any, attribute: str, wrong: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, attribute, wrong)
    (finding,) = run_checks([c for c in selftest_checks.all_checks() if c.name == name], 0.0)
    assert (finding.fault, finding.state) == ("", "failed")
