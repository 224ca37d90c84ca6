"""Command line of ``mbtf-gen``."""

from __future__ import annotations

from mbtf_core.app.console import CONSOLE, Console, new_app
from mbtf_gen.cli.exchange import import_measured, publish
from mbtf_gen.cli.folders import merge, repair, verify
from mbtf_gen.cli.generate import generate
from mbtf_gen.cli.material import inspect, plan
from mbtf_gen.cli.pictures import preview, reference


def doctor(*, console: Console = CONSOLE) -> int:
    """Test the installation, and suggest a fix for each failure."""
    from mbtf_gen.diagnostics.checks import report_checks
    from mbtf_gen.diagnostics.doctor import all_checks
    from mbtf_gen.engine.runtime import use_shipped_llvm

    use_shipped_llvm()
    return report_checks(all_checks(), console, workers=4)


def selftest(*, console: Console = CONSOLE) -> int:
    """Check the physics against known results on this machine.

    It reports the largest deviations. Exit code 0 when every check passed, 3 otherwise.
    """
    from mbtf_gen.diagnostics.checks import report_checks
    from mbtf_gen.diagnostics.selftest import all_checks
    from mbtf_gen.engine.runtime import load_mitsuba

    load_mitsuba()
    return report_checks(all_checks(), console)


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
app.command(publish)
