"""The viewer's page of a run: its fits, and the path-traced pictures beside them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mbtf_core.directions import from_angles
from mbtf_core.errors import InputError
from mbtf_core.files.atomic import read_json, write_text
from mbtf_core.pictures import Camera
from mbtf_fit.viewer.content import material_content
from mbtf_fit.viewer.extras import picture_content, tiles_text
from mbtf_fit.viewer.page import write_page
from mbtf_pipeline.compare.compare import COMPARISON_NAME
from mbtf_pipeline.compare.image_files import read_picture
from mbtf_pipeline.run_folder import COMPARE, FITS, VIEWER

# Path-traced pictures in a page.
_MOST_PICTURES = 4

_log = logging.getLogger(__name__)


def write_viewer(folder: Path, title: str, comparison: Mapping[str, Any]) -> None:
    """Write ``viewer.html`` of a finished run; none where no fit can be shown in a browser.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    title : str
        Of the page.
    comparison : mapping
        Content of ``comparison.json``.
    """
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
    write_text(path, write_page({"materials": materials, "pictures": run_pictures(folder)}, title))


def run_pictures(folder: Path) -> list[dict[str, Any]]:
    """The first path-traced pictures of a run's comparison."""
    comparison = read_json(folder / COMPARE / COMPARISON_NAME)
    return [_picture(folder, picture) for picture in comparison["pictures"][:_MOST_PICTURES]]


def _picture(folder: Path, picture: Mapping[str, Any]) -> dict[str, Any]:
    view, light, across = picture["view"], picture["light"], picture["tiles_across"]
    reference = picture["references"].get("query") or next(iter(picture["references"].values()))
    value = read_picture(folder / COMPARE / reference["file"])
    camera = Camera(view["elevation"], view["azimuth"], across)
    name = f"path-traced, light {light['elevation']:g}°, {tiles_text(across)} across"
    return picture_content(name, value, camera, from_angles(light["elevation"], light["azimuth"]))
