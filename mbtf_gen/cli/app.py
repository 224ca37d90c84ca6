"""Command line of ``mbtf-gen``."""

from __future__ import annotations

from mbtf_core.app.console import CONSOLE, Console, new_app
from mbtf_core.app.options import Time
from mbtf_gen.cli.exchange import export, import_measured, publish
from mbtf_gen.cli.folders import merge, repair, verify
from mbtf_gen.cli.generate import generate
from mbtf_gen.cli.material import inspect, plan
from mbtf_gen.cli.pictures import preview, reference


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


app = new_app(
    "mbtf-gen",
    "Generate multi-resolution BTF (MBTF) data sets from displaced materials.",
    "mbtf-gen assets/cliff_rock --quality draft -o shards/",
    "mbtf-gen heightfield.exr --height-scale 0.1 --queries 400/texel -o shards/",
)
app.usage = "Usage: mbtf-gen MATERIAL [OPTIONS]\n       mbtf-gen COMMAND [OPTIONS]"
app.default(generate)
for command in (inspect, plan, preview, merge, verify, repair, reference, selftest, doctor):
    app.command(command)
app.command(import_measured, name="import")
app.command(export)
app.command(publish)
