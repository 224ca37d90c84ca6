"""Checks of an installation: how ``mbtf-gen doctor`` and ``mbtf-gen selftest`` run and report theirs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Literal

from mbtf_core.app.console import Console
from mbtf_core.errors import EXIT_BAD_INPUT, EXIT_OK, MbtfError, reason


class Absent(Exception):
    """This machine lacks the part under test."""


@dataclass(frozen=True)
class Check:
    """A check.

    Attributes
    ----------
    name : in a few words
    run : returns what it found, in words; raises :class:`Absent`, or any other exception for a fault
    required : whether its failure is one of the installation
    hint : what to do where it fails and says nothing itself
    """

    name: str
    run: Callable[[], str]
    required: bool = True
    hint: str = ""


@dataclass(frozen=True)
class Finding:
    """What a check found, in words, and what to do about it."""

    name: str
    required: bool
    state: Literal["ok", "failed", "absent"]
    found: str
    hint: str = ""


def run_check(check: Check) -> Finding:
    """Run a check; whatever goes wrong is a finding."""
    try:
        return Finding(check.name, check.required, "ok", check.run())
    except Absent as missing:
        return Finding(check.name, check.required, "absent", str(missing))
    except MbtfError as error:
        what = f"{error.where}: {error.what}" if error.where else error.what
        return Finding(check.name, check.required, "failed", what, error.hint or check.hint)
    except Exception as error:
        return Finding(check.name, check.required, "failed", reason(error), check.hint)


def report_checks(checks: Sequence[Check], console: Console, workers: int = 1) -> int:
    """Run checks, some at a time; print a table with hints, or a JSON object. Returns the exit code: 3 when a
    required check failed."""
    with ThreadPoolExecutor(workers) as pool:
        findings = list(pool.map(run_check, checks))
    failed = [f.name for f in findings if f.required and f.state == "failed"]
    width = max(len(f.name) for f in findings)
    lines = []
    for f in findings:
        lines.append(f"{f.state:<7} {f.name:<{width}}  {f.found}")
        if f.hint:
            lines.append(f"{'':<7} {'':<{width}}  → {f.hint}")
    lines += ["", f"failed: {', '.join(failed)}" if failed else "every required check passed"]
    console.report({"ok": not failed, "checks": [asdict(f) for f in findings]}, "\n".join(lines))
    return EXIT_BAD_INPUT if failed else EXIT_OK
