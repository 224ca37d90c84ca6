"""Command line of ``mbtf-pipeline``."""

from __future__ import annotations

from mbtf_core.app.console import new_app
from mbtf_pipeline.cli.cost import cost
from mbtf_pipeline.cli.run import list_recipes, report, run

app = new_app(
    "mbtf-pipeline",
    "Run recipes: generate, fit, compare, report.",
    "mbtf-pipeline run pipelines/quickstart.yaml",
    "mbtf-pipeline cost pipelines/quickstart.yaml --time 10min",
)
for command in (run, report, cost):
    app.command(command)
app.command(list_recipes, name="list")
