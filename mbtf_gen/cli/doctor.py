"""``mbtf-gen doctor``: what this machine has."""

from __future__ import annotations

from mbtf_core.console import CONSOLE, Console


def doctor(*, console: Console = CONSOLE) -> int:
    """Say what this machine has, prove each part by using it, and name the hint for what fails."""
    from mbtf_gen.diagnostics.doctor import as_json, as_text, diagnose, exit_code

    checks = diagnose()
    console.report(as_json(checks), as_text(checks))
    return exit_code(checks)
