"""Self-test of the physics on the user's machine: ``mbtf-gen selftest``.

Every check measures quantities whose true values are known and reports the worst case: its error, and the
standard error of the measurement. A check passes if the error of each case is at most its tolerance plus
4.5 standard errors. Checks repeat with new random numbers until the time is up; that reduces the standard
errors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, MbtfError, reason

# Exceeded by one normal error in 150 000: with a hundred cases, one false alarm in 1500 runs.
STANDARD_ERRORS = 4.5

Unit = Literal["relative", "count", "rad"]


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes
    ----------
    off : measured minus true value, in the unit of the check
    error : its standard error; 0 for deterministic cases
    """

    off: float
    error: float = 0.0


@dataclass(frozen=True)
class Check:
    """A property with a known answer.

    Attributes
    ----------
    name, statement : in a few words, and in a sentence
    tolerance : error that a case may have, beside its statistical error
    measure : cases by name of one round; each round, numbered from 0, has its own random numbers. None means
        that the part under test is absent
    unit : of the measured quantity
    repeated : more rounds reduce the statistical error
    required : a failure fails the self-test
    """

    name: str
    statement: str
    tolerance: float
    measure: Callable[[int], Mapping[str, Case] | None]
    unit: Unit = "relative"
    repeated: bool = True
    required: bool = True


@dataclass
class Finding:
    """The result of a check.

    Attributes
    ----------
    cases : mean over the rounds, by name; rounds : their number; seconds : their time
    fault : why the check could not run; empty if it did
    """

    check: Check
    cases: dict[str, Case] = field(default_factory=dict)
    rounds: int = 0
    seconds: float = 0.0
    fault: str = ""

    @property
    def worst(self) -> tuple[str, Case] | None:
        """Name and measurement of the case closest to its limit."""
        if not self.cases:
            return None
        return max(self.cases.items(), key=lambda item: abs(item[1].off) / self._limit(item[1]))

    def _limit(self, case: Case) -> float:
        return max(self.check.tolerance + STANDARD_ERRORS * case.error, 1e-300)

    @property
    def state(self) -> Literal["ok", "failed", "absent"]:
        """``absent``: this machine lacks the part under test."""
        if self.fault:
            return "failed"
        if not self.cases:
            return "absent"
        good = all(math.isfinite(c.error) and abs(c.off) <= self._limit(c) for c in self.cases.values())
        return "ok" if good else "failed"

    def add(self, cases: Mapping[str, Case]) -> None:
        """Include another round in the means."""
        n = self.rounds
        for name, new in cases.items():
            old = self.cases.get(name, Case(0.0))
            mean = (n * old.off + new.off) / (n + 1)
            self.cases[name] = Case(mean, math.hypot(n * old.error, new.error) / (n + 1))
        self.rounds += 1

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``."""
        name, worst = self.worst or (None, None)
        return {
            **{
                key: getattr(self.check, key)
                for key in ("name", "statement", "required", "unit", "tolerance")
            },
            "state": self.state,
            "worst_case": name,
            "worst": worst and worst.off,
            "error": worst and worst.error,
            "cases": len(self.cases),
            "rounds": self.rounds,
            "seconds": round(self.seconds, 2),
            "fault": self.fault,
        }


def run_checks(
    checks: Sequence[Check], seconds: float, progress: Callable[[float, str], None] | None = None
) -> list[Finding]:
    """Run every check once, then repeat those that gain from it until `seconds` have passed.

    Parameters
    ----------
    checks : checks to run
    seconds : time to use; every check runs at least once
    progress : called before each round with (seconds passed, name of the check)
    """
    start = time.monotonic()
    findings = [Finding(check) for check in checks]

    def one_round(finding: Finding) -> None:
        if progress is not None:
            progress(time.monotonic() - start, finding.check.name)
        before = time.monotonic()
        try:
            cases = finding.check.measure(finding.rounds)
        except MbtfError as error:
            finding.fault = error.what
        except Exception as error:  # whatever goes wrong is a finding
            finding.fault = reason(error)
        else:
            if cases is not None:
                finding.add(cases)
        finding.seconds += time.monotonic() - before

    for finding in findings:
        one_round(finding)
    repeated = [f for f in findings if f.check.repeated and f.state != "absent" and not f.fault]
    while repeated and time.monotonic() - start < seconds:
        # The check with the least time so far, so that all get the same.
        finding = min(repeated, key=lambda f: f.seconds)
        one_round(finding)
        if finding.fault:
            repeated.remove(finding)
    return findings


def exit_code(findings: Sequence[Finding]) -> int:
    """0, or 3 when a required check failed."""
    failed = any(f.check.required and f.state == "failed" for f in findings)
    return EXIT_BAD_INPUT if failed else EXIT_OK
