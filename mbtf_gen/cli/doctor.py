"""``mbtf-gen doctor``: whether the installation works."""

from __future__ import annotations

from mbtf_core.app.console import CONSOLE, Console


def doctor(*, console: Console = CONSOLE) -> int:
    """Test each part of the installation, and suggest a fix for each failure."""
    from mbtf_gen.diagnostics.doctor import as_json, as_text, diagnose, exit_code

    checks = diagnose()
    console.report(as_json(checks), as_text(checks))
    return exit_code(checks)
