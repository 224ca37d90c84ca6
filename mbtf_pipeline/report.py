"""The report: one HTML file that holds everything it shows."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from mbtf_gen.atomic import read_json, write_text

from .compare import COMPARISON_NAME
from .embed import embed, signed_colours
from .fit_records import read_training
from .recipe import RECIPE_NAME, Recipe
from .report_errors import error_context
from .report_pictures import Gallery, show_offsets, show_pictures
from .report_time import provenance, time_context
from .report_training import training_context
from .run_folder import COMPARE, FITS, REPORT, RUN_NAME, SHARDS

_TABLE = """
<table><thead><tr>{% for h in t.head %}<th>{{ h }}</th>{% endfor %}</tr></thead><tbody>
{% for row in t.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table>
"""


def _environment() -> Any:
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    table = environment.from_string(_TABLE)
    environment.globals["table"] = lambda t: Markup(table.render(t=t))
    return environment


def _gradient() -> str:
    """CSS of the difference scale, the same colours as in the pictures."""
    import numpy as np

    colours = signed_colours(np.linspace(-1.0, 1.0, 9))
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b})' for r, g, b in colours)})"


def write_report(folder: Path, recipe: Recipe, stages: Sequence[str]) -> int:
    """Write ``report.html`` of the finished run in `folder`; returns its size in bytes.

    Raises
    ------
    InputError : a file of the run is missing or damaged
    """
    comparison = read_json(folder / COMPARE / COMPARISON_NAME)
    manifest = read_json(folder / SHARDS / "manifest.json")
    run = read_json(folder / RUN_NAME)
    white = comparison["white"] if recipe.report.exposure is None else 1.0 / recipe.report.exposure
    gallery = Gallery()
    shown = show_pictures(folder / COMPARE, comparison, white, list(recipe.report.stops), gallery)
    offsets = show_offsets(folder / COMPARE, comparison["offsets"], gallery)
    fit_folders = {name: folder / FITS / name for name in comparison["fits"]}
    histories = {name: read_training(path) for name, path in fit_folders.items()}
    context: dict[str, Any] = {
        "title": recipe.title,
        "comparison": comparison,
        "description": recipe.description,
        "groups": shown.groups,
        "heroes": shown.heroes,
        "columns": shown.columns,
        "gradient": _gradient(),
        "scale_low": f"−{shown.scale:.0%}" if shown.scale >= 0.01 else f"−{shown.scale:.1%}",
        "scale_high": f"+{shown.scale:.0%}" if shown.scale >= 0.01 else f"+{shown.scale:.1%}",
        "scale_text": "of white, fit minus reference, mean of the channels",
        "stops": [_stop(s) for s in recipe.report.stops],
        "offsets": offsets,
        "offset_columns": len(offsets[0]["cells"]) if offsets else 1,
        "effects": manifest["effects"]["effects"],
        "command": run["command"],
        "recipe_yaml": (folder / RECIPE_NAME).read_text(encoding="utf-8"),
        "provenance": provenance(folder, manifest, fit_folders, run["machine"]),
        **error_context(comparison),
        **training_context(histories),
        **time_context(folder, stages, manifest, comparison, histories),
    }
    plots = [p["svg"] for key in ("error_plots", "training_plots", "time_plots") for p in context[key]]
    budget = recipe.report.max_megabytes * 1e6 - sum(map(len, plots)) - 200_000
    images, encoding = embed(gallery.makers, budget)
    context["images"] = images
    context["white"] = white
    context["encoding"] = encoding.name
    template = (files("mbtf_pipeline") / "templates" / "report.html").read_text(encoding="utf-8")
    html = _environment().from_string(template).render(context)
    write_text(folder / REPORT, html)
    return len(html.encode())


def _stop(stop: float) -> str:
    return "±0 EV" if stop == 0 else f"{stop:+g} EV".replace("-", "−")
