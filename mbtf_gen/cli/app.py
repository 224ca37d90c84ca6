"""Command line of ``mbtf-gen``."""

from __future__ import annotations

from mbtf_core.app.console import new_app
from mbtf_gen.cli.diagnostics import doctor, selftest
from mbtf_gen.cli.folders import merge, repair, verify
from mbtf_gen.cli.generate import generate
from mbtf_gen.cli.material import inspect, plan
from mbtf_gen.cli.measured import export, import_measured
from mbtf_gen.cli.pictures import preview, reference
from mbtf_gen.cli.publish import publish

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
