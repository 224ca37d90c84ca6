"""``mbtf-fit models``: the models that are installed, and what they are made of."""

from __future__ import annotations

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
        exported = (getattr(ops, name) for name in ops.__all__)
        kinds = [k for k in exported if isinstance(k, type) and issubclass(k, ops.Operation)]
        found = [
            {"name": k.__name__, "call": k.signature(), "description": k.summary().replace("`", "")}
            for k in kinds
            if k is not ops.Operation
        ]
        lines = "\n".join(f"{one['call']}\n    {one['description']}" for one in found)
        console.report({"operations": found}, lines)
        return
    found = [
        {"name": name, "layout": model.layout, "description": model.description}
        for name, model in sorted(MODELS.items())
    ]
    rows = [["model", *list(found[0])[1:]], *(list(one.values()) for one in found)]
    console.report({"models": found}, format_table(rows))
