"""``mbtf-fit models``: the models that are installed, and what they are made of."""

from __future__ import annotations

import re

from mbtf_core.app.console import CONSOLE, Console
from mbtf_core.app.options import Switch


def models(*, operations: Switch = False, console: Console = CONSOLE) -> None:
    """List the models that --model takes, with the layout of their data.

    Parameters
    ----------
    operations
        List instead the operations that a model is made of.
    """
    from mbtf_fit import ops
    from mbtf_fit.formatting import format_table
    from mbtf_fit.models.registry import MODELS

    if operations:
        kinds = [kind for name, kind in vars(ops).items() if isinstance(kind, type) and name in ops.__all__]
        found = [
            {"name": kind.__name__, "description": _first_paragraph(kind.__doc__ or "")}
            for kind in kinds
            if kind is not ops.Operation and issubclass(kind, ops.Operation)
        ]
    else:
        found = [
            {"name": name, "layout": model.layout, "description": model.description}
            for name, model in sorted(MODELS.items())
        ]
    what = "operations" if operations else "models"
    rows = [[what.removesuffix("s"), *list(found[0])[1:]], *(list(one.values()) for one in found)]
    console.report({what: found}, format_table(rows))


def _first_paragraph(docstring: str) -> str:
    """The first paragraph on one line, without markup."""
    text = " ".join(docstring.split("\n\n")[0].split())
    return re.sub(r":\w+:`~?(?:[\w.]+\.)?(\w+)`", r"\1", text).replace("``", "")
