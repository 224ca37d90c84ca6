"""``mbtf-gen selftest``: physics with known answers on this machine."""

from __future__ import annotations

from pathlib import Path

from mbtf_core.console import CONSOLE, Console
from mbtf_core.errors import UsageError
from mbtf_core.options import Time

# Of the HTML report, about.
REPORT_BYTES = 100_000


def selftest(*, report: Path | None = None, time: Time = "2min", console: Console = CONSOLE) -> int:
    """Check the physics against known results on this machine, and report the largest deviation.

    Each check runs at least once; a longer time means smaller statistical errors. Exit code 0 when every
    check passed, 3 otherwise.

    Parameters
    ----------
    report
        Write every case to this HTML file.
    """
    from mbtf_core.units import asked_duration, expectation

    seconds = asked_duration(time or "2min", "--time")
    if report is not None and report.suffix != ".html":
        raise UsageError(f"'{report.name}' must end in .html", where="--report")
    from mbtf_gen.diagnostics.checks import all_checks
    from mbtf_gen.diagnostics.report import as_html, as_json, as_text
    from mbtf_gen.diagnostics.selftest import exit_code, run_checks
    from mbtf_gen.engine.runtime import load_mitsuba

    console.note(expectation(seconds, 0 if report is None else REPORT_BYTES))
    load_mitsuba()
    with console.progress(total=seconds, label="checking", unit="s") as bar:
        findings = run_checks(
            all_checks(), seconds, lambda done, name: bar.update(round(min(done, seconds)), name)
        )
    if report is not None:
        from mbtf_core.atomic import write_text

        write_text(report, as_html(findings))
    console.report(as_json(findings), as_text(findings))
    return exit_code(findings)
