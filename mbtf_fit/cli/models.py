"""``mbtf-fit models``: the models that are installed."""

from __future__ import annotations

from mbtf_core.app.console import CONSOLE, Console


def models(*, console: Console = CONSOLE) -> None:
    """List the models that --model takes, with the layout of their data."""
    from mbtf_fit.formatting import format_table
    from mbtf_fit.models.registry import MODELS

    found = [
        {"name": name, "layout": model.layout, "description": model.description}
        for name, model in sorted(MODELS.items())
    ]
    rows = [["model", "layout", "description"], *(list(model.values()) for model in found)]
    console.report({"models": found}, format_table(rows))
