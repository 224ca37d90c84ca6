"""The report: one self-contained HTML file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_text
from mbtf_core.config_file import check_schema
from mbtf_gen.config.effects_request import EFFECTS
from mbtf_pipeline.compare.compare import COMPARISON_NAME, COMPARISON_SCHEMA
from mbtf_pipeline.fit_records import read_training
from mbtf_pipeline.formatting import NOT_SIGNIFICANT
from mbtf_pipeline.recipe import RECIPE_NAME, Recipe
from mbtf_pipeline.report.embed import ENCODINGS, Embedded, Gallery, embed, encode
from mbtf_pipeline.report.error_maps import palette
from mbtf_pipeline.report.errors import error_context
from mbtf_pipeline.report.linear_images import EXPOSURE_STOPS
from mbtf_pipeline.report.offsets import offset_section
from mbtf_pipeline.report.pictures import PictureSection, picture_section
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.times import provenance, time_context
from mbtf_pipeline.report.training import training_context
from mbtf_pipeline.run_folder import COMPARE, FITS, REPORT, RUN_NAME, SHARDS

# Raised when the page changes; part of the stage's key.
LAYOUT = 5

_TABLE = """
<table><thead><tr>{% for h in t.head %}<th>{{ h }}</th>{% endfor %}</tr></thead><tbody>
{% for row in t.rows %}<tr>
{%- for cell in row %}
{%- if cell is command %}<td class=command><code>{{ cell }}</code></td>
{%- else %}<td{{ ' class=long' if cell is long }}>{{ cell }}</td>{% endif %}
{%- endfor %}</tr>
{% endfor %}</tbody></table>
"""


def page_environment() -> Any:
    """Jinja environment of all pages; ``table`` renders a table."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.tests["long"] = lambda cell: NOT_SIGNIFICANT in cell
    environment.tests["command"] = lambda cell: cell.startswith("mbtf-")
    table = environment.from_string(_TABLE)
    environment.globals["table"] = lambda t: Markup(table.render(t=t))
    return environment


def write_report(folder: Path, recipe: Recipe, stages: Sequence[str]) -> int:
    """Write ``report.html`` of a finished run.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    recipe : Recipe
        Its title, exposure and size limit are used.
    stages : sequence of str
        Names of the stages whose times are shown.

    Returns
    -------
    int
        Size of the file in bytes.

    Raises
    ------
    InputError
        A file of the run is missing, corrupt or of another version.
    """
    path = folder / COMPARE / COMPARISON_NAME
    comparison = read_json(path)
    hint = "run the recipe again: it repeats the comparison and keeps data and fits"
    check_schema(comparison, COMPARISON_SCHEMA, path, hint)
    manifest = read_json(folder / SHARDS / "manifest.json")
    run = read_json(folder / RUN_NAME)
    white = comparison["white"] if recipe.report.exposure is None else 1.0 / recipe.report.exposure
    gallery = Gallery(white)
    shown = picture_section(folder / COMPARE, comparison, gallery)
    offsets = offset_section(folder / COMPARE, comparison["offsets"], gallery)
    fit_folders = {name: folder / FITS / name for name in comparison["fits"]}
    histories = {name: read_training(path) for name, path in fit_folders.items()}
    context: dict[str, Any] = {
        "title": recipe.title,
        "comparison": comparison,
        "description": recipe.description,
        "groups": shown.groups,
        "scenes": shown.scenes,
        "color_bars": {bar.key: bar for bar in shown.color_bars},
        "error_bar_note": ERROR_BAR_NOTE,
        "train_spp": manifest["splits"]["train"]["spp"],
        "offsets": offsets,
        "effects": manifest["effects"]["effects"],
        "effect_labels": EFFECTS,
        "command": run["command"],
        "recipe_yaml": (folder / RECIPE_NAME).read_text(encoding="utf-8"),
        "provenance": provenance(folder, manifest, fit_folders, run["machine"]),
        **error_context(comparison, float(manifest["config"]["queries"]["min_cos"])),
        **training_context(histories),
        **time_context(folder, stages, manifest, comparison, histories),
    }
    budget = recipe.report.max_megabytes * 1e6
    # The size of the page without images, from the smallest encoding.
    smallest = encode(gallery, ENCODINGS[-1])
    rest = len(_render(context, comparison, shown, smallest, white).encode()) - smallest.size
    html = _render(context, comparison, shown, embed(gallery, budget - rest), white)
    write_text(folder / REPORT, html)
    return len(html.encode())


def _render(
    context: Mapping[str, Any],
    comparison: Mapping[str, Any],
    shown: PictureSection,
    embedded: Embedded,
    white: float,
) -> str:
    images = {
        "images": embedded.images,
        "white": white,
        "encoding": embedded.encoding.describe(embedded.coding),
        "stops": EXPOSURE_STOPS,
        "viewer": _viewer(comparison, shown, embedded, white),
        "style": template("report.css"),
        "script": template("report.js"),
    }
    html: str = page_environment().from_string(template("report.html")).render(context, **images)
    return html


def template(name: str) -> str:
    """Text of a file of ``templates/``."""
    return (files("mbtf_pipeline.report") / "templates" / name).read_text(encoding="utf-8")


def _viewer(comparison: Mapping[str, Any], shown: PictureSection, embedded: Embedded, white: float) -> str:
    """Data of the page's script, as JSON that is valid within a ``<script>`` element."""
    data = {
        "white": white,
        "coding": embedded.coding.describe(),
        "fits": comparison["fits"],
        "scenes": shown.scenes,
        "pictures": embedded.packed,
        "difference": {"scale": shown.difference * white, "colors": palette("signed")},
    }
    return json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
