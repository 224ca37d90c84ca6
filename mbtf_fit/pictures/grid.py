"""Pictures in columns and rows, with a caption above each column and a label in each row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mbtf_core.color import Palette, palette, tick_labels

U8 = NDArray[np.uint8]
GAP, MARGIN, CAPTION = 4, 8, 34
INK, PAPER = (30, 30, 30), (255, 255, 255)
# Heights of a color bar, and of it with its numbers.
_BAR, BAR_STRIP = 10, 30


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


def color_bar(width: int, name: Palette, high: float, unit: str) -> U8:
    """A color bar of magnitudes from 0 to `high`, so many pixels wide, with its numbers and their unit below,
    as (BAR_STRIP, width, 3) sRGB."""
    strip = np.full((BAR_STRIP, width, 3), PAPER, np.uint8)
    strip[:_BAR] = palette(name)[np.arange(width) * 256 // width]
    image, font = Image.fromarray(strip), ImageFont.load_default(11)
    draw = ImageDraw.Draw(image)
    ticks = tick_labels(0.0, high)
    ticks[-1] += unit
    anchors = ("lt", *("mt" for _ in ticks[2:]), "rt")
    for x, tick, anchor in zip(np.linspace(0, width - 1, len(ticks)), ticks, anchors, strict=True):
        draw.text((float(x), _BAR + 5), tick, INK, font, anchor=anchor)
    return np.asarray(image)


def with_bar(sheet: U8, bar: U8) -> U8:
    """A :func:`grid` with a color bar below its last column, which is as wide."""
    footer = np.full((BAR_STRIP, sheet.shape[1], 3), PAPER, np.uint8)
    footer[:, -MARGIN - bar.shape[1] : -MARGIN] = bar
    return np.concatenate([sheet, footer])


def _label(draw: ImageDraw.ImageDraw, corner: tuple[int, int], text: str, font: Any) -> None:
    """Text in the lower left corner of a picture, on a white background."""
    left, bottom = corner
    box = draw.textbbox((0, 0), text, font=font)
    top = bottom - (box[3] - box[1]) - 6
    draw.rectangle((left, top, left + box[2] - box[0] + 6, bottom - 1), PAPER)
    draw.text((left + 3, top + 3 - box[1]), text, INK, font)
