"""The contact sheet: a plane of the material for several views, lights and widths of the field of view.

A pixel is the material's value M for a single query, as in ``mbtf-gen reference --kind query``; the light has
unit irradiance on the plane.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mbtf_core.color import auto_exposure, brightness, to_display
from mbtf_core.directions import from_angles
from mbtf_core.pictures import Camera
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.stored_material import F32
from mbtf_fit.preview.config import SheetSection
from mbtf_gen.config.pictures import Direction

GAP, MARGIN, CAPTION = 4, 8, 34
INK, PAPER = (30, 30, 30), (255, 255, 255)


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


def exposure_of(values: F32) -> float:
    """The automatic exposure of a sheet, in EV."""
    return auto_exposure(map(brightness, values.reshape(-1, *values.shape[-3:])))


def contact_sheet(values: F32, section: SheetSection, exposure: float) -> NDArray[np.uint8]:
    """The sheet (rows, columns, 3): a column per view and light, a row per width."""
    views, lights, widths, size = values.shape[:4]
    pitch = size + GAP
    width = 2 * MARGIN + views * lights * pitch - GAP + (views - 1) * GAP
    height = MARGIN + widths * pitch - GAP + CAPTION + MARGIN
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(max(9, min(13, size // 12)))
    for view in range(views):
        for light in range(lights):
            # A wider gap separates views.
            left = MARGIN + (view * lights + light) * pitch + view * GAP
            text = f"{_caption('view', section.view[view])}\n{_caption('light', section.light[light])}"
            draw.multiline_text((left + 1, MARGIN), text, INK, font, spacing=2)
            for row in range(widths):
                picture = Image.fromarray(to_display(values[view, light, row], exposure))
                top = MARGIN + CAPTION + row * pitch
                sheet.paste(picture, (left, top))
                if view == light == 0:
                    across = section.tiles_across[row]
                    label = f"{across:g} tile{'' if across == 1 else 's'} wide"
                    _label(draw, (left, top + size), label, font)
    return np.asarray(sheet)


def _caption(name: str, direction: Direction) -> str:
    return f"{name} {direction.elevation:g}°, {direction.azimuth:g}°"


def _label(draw: ImageDraw.ImageDraw, corner: tuple[int, int], text: str, font: Any) -> None:
    """Text in the lower left corner of a picture, on a white background."""
    left, bottom = corner
    box = draw.textbbox((0, 0), text, font=font)
    top = bottom - (box[3] - box[1]) - 6
    draw.rectangle((left, top, left + box[2] - box[0] + 6, bottom - 1), PAPER)
    draw.text((left + 3, top + 3 - box[1]), text, INK, font)
