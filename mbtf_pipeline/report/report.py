"""The report: one self-contained HTML file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mbtf_core.color import describe_exposure
from mbtf_core.config.settings import check_schema
from mbtf_core.files.atomic import read_json, write_text
from mbtf_pipeline.compare.compare import COMPARISON_NAME, COMPARISON_SCHEMA
from mbtf_pipeline.number_text import NOT_SIGNIFICANT
from mbtf_pipeline.recipe import RECIPE_NAME, Recipe
from mbtf_pipeline.report.embed import ENCODINGS, Gallery, encode
from mbtf_pipeline.report.errors import error_context
from mbtf_pipeline.report.image_sheet import picture_section
from mbtf_pipeline.report.material import material_section
from mbtf_pipeline.report.offset_images import offset_section
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.times import provenance, read_training, time_context, training_context
from mbtf_pipeline.run_folder import COMPARE, FITS, REPORT, RUN, SHARDS

# Raised when the report or the viewer's page changes; part of the stage's key.
LAYOUT = 12

_TABLE = """
{%- set below = t.head[-1] == "command" %}
{%- set head = t.head[:-1] if below else t.head %}
<table><thead><tr>{% for h in head %}<th>{{ h }}</th>{% endfor %}</tr></thead><tbody>
{% for row in t.rows %}<tr>
{%- for cell in row %}
{%- if below and loop.last %}</tr>
<tr class=command><td class=command colspan={{ row|length - 1 }}><code>{{ cell }}</code></td>
{%- elif cell is command %}<td class=command><code>{{ cell }}</code></td>
{%- else %}<td{{ ' class=long' if cell is long }}>{{ cell }}</td>{% endif %}
{%- endfor %}</tr>
{% endfor %}</tbody></table>
"""


def render(page: str, **context: Any) -> str:
    """A page of ``templates/`` as HTML."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    templates = PackageLoader("mbtf_pipeline.report")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, loader=templates)
    environment.tests["long"] = lambda cell: NOT_SIGNIFICANT in cell
    environment.tests["command"] = lambda cell: cell.startswith("mbtf-")
    table = environment.from_string(_TABLE)
    environment.globals["table"] = lambda t: Markup(table.render(t=t))
    return environment.get_template(page).render(context)


def write_report(folder: Path, recipe: Recipe, stages: Sequence[str]) -> None:
    """Write ``report.html`` of a finished run.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    recipe : Recipe
        Its title, exposure and size limit are used.
    stages : sequence of str
        Names of the stages whose times are shown.

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
    run = read_json(folder / RUN.record)
    asked = recipe.report.exposure
    gallery = Gallery(comparison["exposure"] if asked is None else asked)
    shown = picture_section(folder / COMPARE, comparison, gallery)
    fit_folders = {name: folder / FITS / name for name in comparison["fits"]}
    histories = {name: read_training(path) for name, path in fit_folders.items()}
    context: dict[str, Any] = {
        "title": recipe.title,
        "comparison": comparison,
        "description": recipe.description,
        "groups": shown["groups"],
        "color_bars": shown["color_bars"],
        "error_bar_note": ERROR_BAR_NOTE,
        "train_spp": manifest["splits"]["train"]["spp"],
        "offsets": offset_section(folder / COMPARE, comparison["offsets"], gallery),
        "material": material_section(recipe.generate, manifest["inputs"]),
        "effects": manifest["effects"]["effects"],
        "command": run["command"],
        "recipe_yaml": (folder / RECIPE_NAME).read_text(encoding="utf-8"),
        "provenance": provenance(folder, manifest, fit_folders, run["machine"]),
        **error_context(comparison, float(manifest["config"]["queries"]["min_cos"])),
        **training_context(histories),
        **time_context(folder, stages, manifest, comparison),
        "exposure": describe_exposure(gallery.exposure),
    }
    # From best quality to smallest size.
    for encoding in ENCODINGS:
        images = encode(gallery, encoding)
        # The page shows all other images in its sheet.
        differences = {name: uri for name, uri in images.items() if name.endswith("-signed")}
        data = {"fits": comparison["fits"], "scenes": shown["scenes"], "differences": differences}
        html = render(
            "report.html",
            **context,
            images=images,
            encoding=encoding.describe(),
            # Valid within a <script> element.
            viewer=json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c"),
        )
        if len(html.encode()) <= recipe.report.max_megabytes * 1e6:
            break
    write_text(folder / REPORT, html)
