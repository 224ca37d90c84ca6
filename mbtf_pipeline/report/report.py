"""The pages of a run, each one self-contained HTML file: its report, and its fits in a viewer."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mbtf_core.color import describe_exposure
from mbtf_core.config.settings import check_schema
from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json
from mbtf_core.files.editable import read_document, write_document
from mbtf_core.pictures import Camera
from mbtf_core.units import tiles_text
from mbtf_pipeline.compare.compare import COMPARISON_NAME, COMPARISON_SCHEMA
from mbtf_pipeline.compare.image_files import read_picture
from mbtf_pipeline.recipe import RECIPE_NAME, Recipe
from mbtf_pipeline.report.images import Gallery, offset_section, picture_section
from mbtf_pipeline.report.plots import ERROR_BAR_NOTE
from mbtf_pipeline.report.sections import (
    error_context,
    material_section,
    provenance,
    time_tables,
    training_context,
)
from mbtf_pipeline.stages import COMPARE, FITS, REPORT, RUN, SHARDS, VIEWER

# Raised when the report or the viewer's page changes; part of the stage's key.
LAYOUT = 21
# Path-traced pictures in the viewer's page.
_MOST_PICTURES = 4

_log = logging.getLogger(__name__)


def render(page: str, **context: Any) -> str:
    """A page of ``templates/`` as HTML."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    templates = PackageLoader("mbtf_pipeline.report")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, loader=templates)
    return environment.get_template(page).render(context)


def write_report(folder: Path, recipe: Recipe, stages: Sequence[str]) -> None:
    """Write ``report.html`` of a finished run.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    recipe : Recipe
        Its title and exposure are used.
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
    exposure = comparison["exposure"] if asked == "auto" else asked
    gallery: Gallery = {}
    shown = picture_section(folder / COMPARE, comparison, exposure, gallery)
    fit_folders = {name: folder / FITS / name for name in comparison["fits"]}
    training = training_context(fit_folders)
    context: dict[str, Any] = {
        "title": recipe.title,
        "comparison": comparison,
        "description": recipe.description,
        **shown,
        "error_bar_note": ERROR_BAR_NOTE,
        "manifest": manifest,
        "offsets": offset_section(folder / COMPARE, comparison["offsets"], gallery),
        "material": material_section(recipe.generate, manifest["inputs"]),
        "command": run["command"],
        "recipe_yaml": read_document(folder / RECIPE_NAME),
        "provenance": provenance(folder, manifest, comparison["fits"], run["machine"]),
        **error_context(comparison, training),
        **training,
        "time_tables": time_tables(folder, stages, comparison),
        "exposure": describe_exposure(exposure),
    }
    # The page shows all other images in its sheet.
    differences = {name: uri for name, uri in gallery.items() if name.endswith("-signed")}
    data = {"fits": comparison["fits"], "scenes": shown["scenes"], "differences": differences}
    # Valid within a <script> element.
    viewer = json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    write_document(folder / REPORT, render("report.html", **context, images=gallery, viewer=viewer))


def write_viewer(folder: Path, title: str, comparison: Mapping[str, Any]) -> None:
    """Write ``viewer.html`` of a finished run with the content of its ``comparison.json``: its fits, and
    path-traced pictures beside them; none where no fit can be shown in a browser."""
    from mbtf_fit import Material
    from mbtf_fit.viewer.extras import poster
    from mbtf_fit.viewer.page import material_content, write_page

    path = folder / VIEWER
    materials = []
    for name in comparison["fits"]:
        try:
            materials.append(material_content(folder / FITS / name, name)[0])
        except InputError as error:
            _log.info("%s: not in the viewer: %s", name, error)
    if not materials:
        path.unlink(missing_ok=True)
        return
    first = poster(Material.load(folder / FITS / materials[0]["name"]))
    content = {"materials": materials, "poster": first, "pictures": run_pictures(folder)}
    write_document(path, write_page(content, title))


def run_pictures(folder: Path) -> list[dict[str, Any]]:
    """The first path-traced pictures of a run's comparison, for the viewer."""
    from mbtf_fit.viewer.extras import picture_content

    out = []
    for picture in read_json(folder / COMPARE / COMPARISON_NAME)["pictures"][:_MOST_PICTURES]:
        view, light, across = picture["view"], picture["light"], picture["tiles_across"]
        reference = picture["references"].get("query") or next(iter(picture["references"].values()))
        value = read_picture(folder / COMPARE / reference["file"])
        camera = Camera(view["elevation"], view["azimuth"], across)
        name = f"path-traced, light {light['elevation']:g}°, {tiles_text(across)} across"
        light_direction = from_angles(light["elevation"], light["azimuth"])
        out.append(picture_content(name, value, camera, light_direction))
    return out
