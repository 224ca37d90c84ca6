"""``mbtf-gen doctor`` and ``mbtf-gen selftest``: checks of the installation and of its physics."""

from __future__ import annotations

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Time


def doctor(*, console: Console = CONSOLE) -> int:
    """Test the installation, and suggest a fix for each failure."""
    from mbtf_gen.checks import report, run_checks
    from mbtf_gen.doctor import all_checks
    from mbtf_gen.engine.runtime import use_shipped_llvm

    use_shipped_llvm()
    checks = all_checks()
    run_checks(checks, workers=4)
    return report(checks, console)


def selftest(*, time: Time = "2min", console: Console = CONSOLE) -> int:
    """Check the physics against known results on this machine.

    It reports the largest deviation. Each check runs at least once; a longer time means smaller statistical
    errors. Exit code 0 when every check passed, 3 otherwise.
    """
    from mbtf_core.units import asked_duration, expectation

    seconds = asked_duration(time or "2min", "--time")
    from mbtf_gen.checks import report, run_checks
    from mbtf_gen.engine.runtime import load_mitsuba
    from mbtf_gen.selftest import all_checks

    console.note(expectation(seconds, 0))
    load_mitsuba()
    checks = all_checks()
    with console.progress(total=seconds, label="checking", unit="s") as bar:
        run_checks(checks, seconds, lambda done, name: bar.update(round(min(done, seconds)), name))
    return report(checks, console)
