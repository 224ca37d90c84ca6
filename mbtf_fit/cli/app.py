"""Command line of ``mbtf-fit``. A command is imported when it runs; its help is read from its file."""

from __future__ import annotations

import ast
from pathlib import Path

from mbtf_core.app.console import new_app
from mbtf_fit.cli.fit import fit

# File and function of each.
_COMMANDS = {
    "models": ("info", "models"),
    "evaluate": ("evaluate", "evaluate"),
    "compare": ("pictures", "compare"),
    "preview": ("pictures", "preview"),
    "view": ("export", "view"),
    "info": ("info", "info"),
    "export": ("export", "export_material"),
}


def _description(module: str, function: str) -> str:
    """What the docstring of a function says before its parameters."""
    tree = ast.parse(Path(__file__).with_name(f"{module}.py").read_text())
    nodes = (n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == function)
    return (ast.get_docstring(next(nodes)) or "").partition("\n\nParameters\n")[0]


app = new_app(
    "mbtf-fit",
    "Fit neural materials to multi-resolution BTF (MBTF) data.",
    "mbtf-fit shards/ --quality draft -o material/",
    "mbtf-fit evaluate material/ shards/",
)
app.usage = "Usage: mbtf-fit SHARDS [OPTIONS]\n       mbtf-fit COMMAND [OPTIONS]"
app.default(fit)
for name, (module, function) in _COMMANDS.items():
    app.command(f"mbtf_fit.cli.{module}:{function}", name=name, help=_description(module, function))
