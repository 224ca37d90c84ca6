"""Pictures in columns and rows, with a caption above each column and a label in each row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

U8 = NDArray[np.uint8]
GAP, MARGIN, CAPTION = 4, 8, 34
INK, PAPER = (30, 30, 30), (255, 255, 255)


def grid(
    pictures: Sequence[Sequence[U8] | U8], captions: Sequence[str], labels: Sequence[str], group: int
) -> U8:
    """Lay out pictures of equal size.

    Parameters
    ----------
    pictures : by column and row, each (size, size, 3), sRGB
    captions : of the columns, up to two lines
    labels : of the rows, on the pictures of the first column
    group : so many columns lie together; a wider gap separates groups

    Returns
    -------
    (rows, columns, 3) uint8 array
    """
    size = len(pictures[0][0])
    pitch, columns, rows = size + GAP, len(pictures), len(labels)
    width = 2 * MARGIN + columns * pitch - GAP + ((columns - 1) // group) * GAP
    height = MARGIN + rows * pitch - GAP + CAPTION + MARGIN
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(max(9, min(13, size // 12)))
    for column, (caption, shown) in enumerate(zip(captions, pictures, strict=True)):
        left = MARGIN + column * pitch + (column // group) * GAP
        draw.multiline_text((left + 1, MARGIN), caption, INK, font, spacing=2)
        for row, (label, picture) in enumerate(zip(labels, shown, strict=True)):
            top = MARGIN + CAPTION + row * pitch
            sheet.paste(Image.fromarray(picture), (left, top))
            if column == 0:
                _label(draw, (left, top + size), label, font)
    return np.asarray(sheet)


def width_label(tiles_across: float) -> str:
    """Label of the pictures of a width of the field of view."""
    return f"{tiles_across:g} tile{'' if tiles_across == 1 else 's'} wide"


def _label(draw: ImageDraw.ImageDraw, corner: tuple[int, int], text: str, font: Any) -> None:
    """Text in the lower left corner of a picture, on a white background."""
    left, bottom = corner
    box = draw.textbbox((0, 0), text, font=font)
    top = bottom - (box[3] - box[1]) - 6
    draw.rectangle((left, top, left + box[2] - box[0] + 6, bottom - 1), PAPER)
    draw.text((left + 3, top + 3 - box[1]), text, INK, font)
