"""``mbtf-gen doctor``: what this machine has."""

from __future__ import annotations

from ..console import CONSOLE, Console


def doctor(*, console: Console = CONSOLE) -> int:
    """Say what this machine has, prove each part by using it, and name the cure for what fails."""
    from ..doctor import as_json, as_text, diagnose, exit_code

    checks = diagnose()
    console.report(as_json(checks), as_text(checks))
    return exit_code(checks)
