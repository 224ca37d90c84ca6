"""Command line of ``mbtf-fit``."""

from __future__ import annotations

from mbtf_core.app.console import new_app
from mbtf_fit.cli.evaluate import evaluate
from mbtf_fit.cli.export import export_material
from mbtf_fit.cli.fit import fit
from mbtf_fit.cli.info import info
from mbtf_fit.cli.preview import preview
from mbtf_fit.cli.view import view

app = new_app("mbtf-fit", "Fit neural materials to multi-resolution BTF (MBTF) data.")
app.default(fit)
for command in (evaluate, preview, view, info):
    app.command(command)
app.command(export_material, name="export")
