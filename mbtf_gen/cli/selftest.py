"""``mbtf-gen selftest``: physics with known answers on this machine."""

from __future__ import annotations

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Time


def selftest(*, time: Time = "2min", console: Console = CONSOLE) -> int:
    """Check the physics against known results on this machine, and report the largest deviation.

    Each check runs at least once; a longer time means smaller statistical errors. Exit code 0 when every
    check passed, 3 otherwise.
    """
    from mbtf_core.units import asked_duration, expectation

    seconds = asked_duration(time or "2min", "--time")
    from mbtf_gen.diagnostics.selftest import all_checks, as_json, as_text, exit_code, run_checks
    from mbtf_gen.engine.runtime import load_mitsuba

    console.note(expectation(seconds, 0))
    load_mitsuba()
    checks = all_checks()
    with console.progress(total=seconds, label="checking", unit="s") as bar:
        run_checks(checks, seconds, lambda done, name: bar.update(round(min(done, seconds)), name))
    console.report(as_json(checks), as_text(checks))
    return exit_code(checks)
