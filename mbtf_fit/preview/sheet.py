"""The pictures of ``mbtf-fit preview``, and the contact sheet: a plane of the material for several views,
lights and widths of the field of view.

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
from mbtf_core.files.folders import OutputFolder, check_space
from mbtf_core.pictures import PNG_BYTES, Camera, claim_pictures, write_png
from mbtf_core.run.signals import keep_on_interruption
from mbtf_fit.material.format import lattice_of, read_description
from mbtf_fit.preview.config import MaterialPreviewConfig, SheetSection
from mbtf_fit.preview.grid import grid, width_label
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
    return grid(pictures, captions, list(map(width_label, section.tiles_across)), len(section.light))


def _caption(name: str, direction: Direction) -> str:
    return f"{name} el. {direction.elevation:g}°, az. {direction.azimuth:g}°"


SHEET_NAME, GIF_NAME = "sheet.png", "turntable.gif"


def draw(
    config: MaterialPreviewConfig, path: Path, *, sheet_only: bool, overwrite: bool, console: Console
) -> None:
    """Draw the pictures that are missing and report them, in a folder that this process owns.

    Raises
    ------
    InputError : the material cannot be used, or the folder holds something else
    UsageError : a view shows the horizon
    """
    keep_on_interruption(f"the finished pictures are kept in {path}")
    sheet, turn, asked = config.sheet, config.turntable, config.exposure
    counts = len(sheet.view), len(sheet.light), len(sheet.tiles_across)
    pixels = counts[0] * counts[1] * counts[2] * sheet.size**2
    pixels += 0 if sheet_only else turn.frames * turn.size**2
    check_space(path, PNG_BYTES * pixels, "reduce --size or --frames, or choose another folder with -o")
    description, _ = read_description(Path(config.material))
    folder = claim_pictures(
        path,
        "mbtf-fit preview",
        files=(SHEET_NAME, GIF_NAME),
        config=config.model_dump(mode="json"),
        inputs={"weights": description["weights"]["sha256"]},
        overwrite=overwrite,
    )
    shows = {SHEET_NAME: "{} views x {} lights (columns) x {} zooms (rows)".format(*counts)}
    if not sheet_only:
        tiles = turn.tiles_around(lattice_of(description).shape()[1])
        shows[GIF_NAME] = (
            f"a ball with {tiles} tiles around its equator on a plate; {turn.frames} frames, "
            f"{turn.spp} paths per pixel"
        )
    # The exposure in use, by picture; the turntable has that of the sheet.
    found = {name: folder.finished(name, of=asked) for name in shows}
    kept = {name: facts is not None for name, facts in found.items()}
    exposure = (found[SHEET_NAME] or {}).get("exposure", 0.0)
    if not all(kept.values()):
        exposure = _draw_missing(config, folder, kept, exposure, console)
    made = [{"file": path / name, "shows": text, "kept": kept[name]} for name, text in shows.items()]
    lines = [f"{p['file']}: {p['shows']}{' (kept)' if p['kept'] else ''}" for p in made]
    lines.append(describe_exposure(exposure))
    console.report({"folder": path, "pictures": made, "exposure": exposure}, "\n".join(lines))


def _draw_missing(
    config: MaterialPreviewConfig,
    folder: OutputFolder,
    kept: dict[str, bool],
    exposure: float,
    console: Console,
) -> float:
    """Draw pictures that are not kept; returns their exposure."""
    load_mitsuba()
    from mbtf_fit.backends.mitsuba import load_scene
    from mbtf_fit.preview.turntable import frames, write_gif

    bsdf = load_scene({"type": "mbtf", "material": config.material})
    turns = not kept.get(GIF_NAME, True)
    with console.progress(1 + turns * config.turntable.frames, label="drawing", unit="pictures") as bar:
        if not kept[SHEET_NAME]:
            values = panels(bsdf.evaluator, config.sheet)
            exposure = chosen_exposure(
                config.exposure, map(brightness, values.reshape(-1, *values.shape[-3:]))
            )
            write_png(folder.path / SHEET_NAME, contact_sheet(values, config.sheet, exposure))
            facts = {"exposure": exposure, "of": config.exposure}
            folder.keep(SHEET_NAME, [folder.path / SHEET_NAME], facts)
        bar.advance(1, "turntable; --sheet-only leaves it out" if turns else None)
        if turns:
            pictures = []
            for picture in frames(bsdf, config.turntable):
                pictures.append(to_display(picture, exposure))
                bar.advance(1)
            write_gif(folder.path / GIF_NAME, pictures)
            facts = {"exposure": exposure, "of": config.exposure}
            folder.keep(GIF_NAME, [folder.path / GIF_NAME], facts)
    return exposure
