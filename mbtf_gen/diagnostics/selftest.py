"""Physics with known answers on the user's own machine: ``mbtf-gen selftest``.

Every check measures a number whose true value is known and reports the worst case: how far off it is, with
its own statistical error. A check passes when each case is off by no more than its tolerance and 4.5 standard
errors. Checks are repeated with new random numbers until the time is up, so that more time means smaller
errors.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK

# Of normal errors one in 300 000 lies beyond: with a hundred cases one false alarm in three thousand runs.
STANDARD_ERRORS = 4.5

Unit = Literal["relative", "count", "rad"]


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes
    ----------
    off : measured less true value, in the unit of the check
    error : standard error of that; 0 where nothing is random
    """

    off: float
    error: float = 0.0


@dataclass(frozen=True)
class Check:
    """Something that must hold.

    Attributes
    ----------
    name, statement : in a few words, and in a sentence
    unit : of what is measured: ``relative``, ``count``, ``rad``
    tolerance : how far off a case may be, beside its statistical error
    measure : cases by name, of one round; rounds (numbers from 0) draw other random numbers
    repeated : more rounds make its error smaller
    required : a failure fails the self-test; None from `measure` means absent
    """

    name: str
    statement: str
    unit: Unit
    tolerance: float
    measure: Callable[[int], Mapping[str, Case] | None]
    repeated: bool = True
    required: bool = True


@dataclass
class Finding:
    """What a check found.

    Attributes
    ----------
    cases : name → mean over the rounds; rounds : how many; seconds : they took
    fault : why the check could not run; empty where it could
    """

    check: Check
    cases: dict[str, Case] = field(default_factory=dict)
    rounds: int = 0
    seconds: float = 0.0
    fault: str = ""

    @property
    def worst(self) -> tuple[str, Case] | None:
        """Name and measurement of the case that comes closest to its limit."""
        if not self.cases:
            return None
        return max(self.cases.items(), key=lambda item: abs(item[1].off) / self._limit(item[1]))

    def _limit(self, case: Case) -> float:
        return max(self.check.tolerance + STANDARD_ERRORS * case.error, 1e-300)

    @property
    def state(self) -> Literal["ok", "failed", "absent"]:
        """``absent``: what it is about is not on this machine."""
        if self.fault:
            return "failed"
        if not self.cases:
            return "absent"
        good = all(math.isfinite(c.error) and abs(c.off) <= self._limit(c) for c in self.cases.values())
        return "ok" if good else "failed"

    def add(self, cases: Mapping[str, Case]) -> None:
        """Take another round into the means."""
        n = self.rounds
        for name, new in cases.items():
            old = self.cases.get(name, Case(0.0))
            mean = (n * old.off + new.off) / (n + 1)
            self.cases[name] = Case(mean, math.hypot(n * old.error, new.error) / (n + 1))
        self.rounds += 1

    def as_dict(self) -> dict[str, Any]:
        """As plain data for ``--json``."""
        worst = self.worst
        return {
            "name": self.check.name,
            "statement": self.check.statement,
            "state": self.state,
            "required": self.check.required,
            "unit": self.check.unit,
            "worst_case": worst[0] if worst else None,
            "worst": worst[1].off if worst else None,
            "error": worst[1].error if worst else None,
            "tolerance": self.check.tolerance,
            "cases": len(self.cases),
            "rounds": self.rounds,
            "seconds": round(self.seconds, 2),
            "fault": self.fault,
        }


def run_checks(
    checks: Sequence[Check], seconds: float, progress: Callable[[float, str], None] | None = None
) -> list[Finding]:
    """Run every check once, then those that gain by it again and again until `seconds` have passed.

    Parameters
    ----------
    progress : called with (seconds passed, name of the check that is about to run)
    """
    from mbtf_core.errors import MbtfError, reason

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
        except Exception as error:  # whatever goes wrong is what the check is there to find
            finding.fault = reason(error)
        else:
            if cases is not None:
                finding.add(cases)
        finding.seconds += time.monotonic() - before

    for finding in findings:
        one_round(finding)
    repeated = [f for f in findings if f.check.repeated and f.state != "absent" and not f.fault]
    while repeated and time.monotonic() - start < seconds:
        # The one that had least time yet: all get the same.
        finding = min(repeated, key=lambda f: f.seconds)
        one_round(finding)
        if finding.fault:
            repeated.remove(finding)
    return findings


def exit_code(findings: Sequence[Finding]) -> int:
    """0, or 3 when a required check failed."""
    failed = any(f.check.required and f.state == "failed" for f in findings)
    return EXIT_BAD_INPUT if failed else EXIT_OK
