"""Checks of an installation: how ``mbtf-gen doctor`` and ``mbtf-gen selftest`` run and report theirs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal

from mbtf_core.app.console import Console
from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, MbtfError, reason


@dataclass(frozen=True)
class Finding:
    """What a check found.

    Attributes
    ----------
    state : ``absent`` means that this machine lacks the part under test
    found : in words
    hint : what to do about it; empty where nothing is to be done
    noisy : whether another round would reduce a statistical error
    facts : plain data for ``--json``
    """

    state: Literal["ok", "failed", "absent"]
    found: str
    hint: str = ""
    noisy: bool = False
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass
class Check:
    """A check, and what it found.

    Attributes
    ----------
    name : in a few words
    run : does one round of it; rounds are numbered from 0
    required : whether its failure is one of the installation
    hint : what to do where it fails and says nothing itself
    finding, rounds, seconds : of the latest round, their number and time
    """

    name: str
    run: Callable[[int], Finding]
    required: bool = True
    hint: str = ""
    finding: Finding = Finding("absent", "not run")
    rounds: int = 0
    seconds: float = 0.0

    @property
    def failed(self) -> bool:
        """Whether it found a fault."""
        return self.finding.state == "failed"

    def run_round(self) -> None:
        """Run once more; whatever goes wrong is a finding."""
        start = time.monotonic()
        try:
            self.finding = self.run(self.rounds)
        except MbtfError as error:
            what = f"{error.where}: {error.what}" if error.where else error.what
            self.finding = Finding("failed", what, error.hint or self.hint)
        except Exception as error:
            self.finding = Finding("failed", reason(error), self.hint)
        self.rounds += 1
        self.seconds += time.monotonic() - start


def run_checks(
    checks: Sequence[Check],
    seconds: float = 0.0,
    progress: Callable[[float, str], None] = lambda *_: None,
    workers: int = 1,
) -> None:
    """Run every check once, then repeat those with statistical errors until the time is up.

    Parameters
    ----------
    checks : checks to run; they hold the findings
    seconds : time to use; every check runs at least once
    progress : called before each round with (seconds passed, name of the check)
    workers : checks to run at a time in the first round
    """
    start = time.monotonic()

    def run(check: Check) -> None:
        progress(time.monotonic() - start, check.name)
        check.run_round()

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(run, checks))
    noisy = [check for check in checks if check.finding.noisy]
    while noisy and time.monotonic() - start < seconds:
        # The one with the least time so far, so that all get the same.
        run(min(noisy, key=lambda check: check.seconds))


def report(checks: Sequence[Check], console: Console) -> int:
    """Print a table with hints, or a JSON object; returns the exit code, 3 when a required check failed."""
    failed = [check.name for check in checks if check.required and check.failed]
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{check.finding.state:<7} {check.name:<{width}}  {check.finding.found}")
        if check.finding.hint:
            lines.append(f"{'':<7} {'':<{width}}  → {check.finding.hint}")
    lines += ["", f"failed: {', '.join(failed)}" if failed else "every required check passed"]
    stated = ("name", "required", "rounds", "seconds")
    found = [
        {
            **{key: getattr(check, key) for key in stated},
            **{key: getattr(check.finding, key) for key in ("state", "found", "hint")},
            **check.finding.facts,
        }
        for check in checks
    ]
    console.report({"ok": not failed, "checks": found}, "\n".join(lines))
    return EXIT_BAD_INPUT if failed else EXIT_OK
