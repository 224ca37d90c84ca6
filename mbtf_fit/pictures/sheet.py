"""The contact sheet of ``mbtf-fit preview``: a plane of the material for several views, lights and widths of
the field of view.

A pixel is the material's value M for a single query, as in ``mbtf-gen reference --kind query``; the light has
unit irradiance on the plane.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mbtf_core.app.console import Console
from mbtf_core.color import brightness, chosen_exposure, describe_exposure, to_display
from mbtf_core.directions import from_angles
from mbtf_core.files.folders import check_space
from mbtf_core.pictures import PNG_BYTES, Camera, claim_pictures, write_png
from mbtf_core.units import tiles_text
from mbtf_fit.material.format import read_description
from mbtf_fit.pictures.config import MaterialPreviewConfig, SheetSection
from mbtf_fit.pictures.grid import grid
from mbtf_gen.config.pictures import Direction
from mbtf_gen.engine.runtime import load_mitsuba

if TYPE_CHECKING:
    # They import Dr.Jit, which must find its LLVM first.
    from mbtf_fit.backends.mitsuba.evaluator import Evaluator
    from mbtf_fit.backends.mitsuba.stored_material import F32


def panels(evaluator: Evaluator, section: SheetSection) -> F32:
    """Values (views, lights, widths, size, size, 3) in 1/sr.

    Raises
    ------
    UsageError : a view shows the horizon
    """
    aspect = evaluator.lattice.aspect
    lights = [from_angles(light.elevation, light.azimuth) for light in section.light]
    size, target = section.size, (0.5, 0.5 * aspect)
    pictures = []
    for view, light, tiles_across in product(section.view, lights, section.tiles_across):
        camera = Camera(view.elevation, view.azimuth, tiles_across, target, rows=size, columns=size)
        q = camera.queries(light, aspect).flat()
        pictures.append(evaluator.evaluate(q.u, q.sigma, q.omega_i, q.omega_o))
    lead = (len(section.view), len(lights), len(section.tiles_across))
    return np.stack(pictures).reshape(*lead, size, size, 3)


def contact_sheet(values: F32, section: SheetSection, exposure: float) -> NDArray[np.uint8]:
    """The sheet (rows, columns, 3): a column per view and light, a row per width."""
    columns = list(product(section.view, section.light))
    pictures = list(to_display(values, exposure).reshape(len(columns), *values.shape[2:]))
    captions = [f"{_caption('view', view)}\n{_caption('light', light)}" for view, light in columns]
    labels = [f"{tiles_text(across)} wide" for across in section.tiles_across]
    return grid(pictures, captions, labels, len(section.light))


def _caption(name: str, direction: Direction) -> str:
    return f"{name} el. {direction.elevation:g}°, az. {direction.azimuth:g}°"


SHEET_NAME = "sheet.png"


def draw(config: MaterialPreviewConfig, path: Path, *, overwrite: bool, console: Console) -> None:
    """Draw the sheet if it is missing and report it, in a folder that this process owns.

    Raises
    ------
    InputError : the material cannot be used, or the folder holds something else
    UsageError : a view shows the horizon
    """
    sheet = config.sheet
    counts = len(sheet.view), len(sheet.light), len(sheet.tiles_across)
    size = PNG_BYTES * counts[0] * counts[1] * counts[2] * sheet.size**2
    check_space(path, size, "reduce --size, or choose another folder with -o")
    description, _ = read_description(Path(config.material))
    folder = claim_pictures(
        path,
        "mbtf-fit preview",
        files=[SHEET_NAME],
        config=config.model_dump(mode="json"),
        inputs={"weights": description["weights"]["sha256"]},
        overwrite=overwrite,
    )
    facts = folder.finished(SHEET_NAME, of=config.exposure)
    kept, file = facts is not None, path / SHEET_NAME
    if facts is None:
        load_mitsuba()
        from mbtf_fit.backends.mitsuba import load_scene

        with console.progress(1, label="drawing", unit="pictures") as bar:
            evaluator = load_scene({"type": "mbtf", "material": config.material}).evaluator
            values = panels(evaluator, sheet)
            pictures = values.reshape(-1, *values.shape[-3:])
            exposure = chosen_exposure(config.exposure, map(brightness, pictures))
            write_png(file, contact_sheet(values, sheet, exposure))
            facts = {"exposure": exposure, "of": config.exposure}
            folder.keep(SHEET_NAME, [file], facts)
            bar.advance(1)
    shows = "{} views x {} lights (columns) x {} zooms (rows)".format(*counts)
    made = {"file": file, "shows": shows, "kept": kept, "exposure": facts["exposure"]}
    lines = [f"{file}: {shows}{' (kept)' if kept else ''}", describe_exposure(facts["exposure"])]
    console.report(made, "\n".join(lines))
