"""Command line of ``mbtf-gen``."""

from __future__ import annotations

from .commands.doctor import doctor
from .commands.folders import merge, repair, verify
from .commands.generate import generate
from .commands.inspect import inspect
from .commands.plan import plan
from .commands.preview import preview
from .commands.reference import reference
from .commands.selftest import selftest
from .console import new_app

app = new_app("mbtf-gen", "Generate multi-resolution BTF (MBTF) data sets from displaced materials.")
app.default(generate)
for command in (inspect, plan, preview, merge, verify, repair, reference, selftest, doctor):
    app.command(command)
