"""Labels beside points of a plot, placed so that they overlap neither each other nor points or lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_SIZE = 7.5
# Candidate offsets of a label from its point, in points; their signs give the alignment.
_OFFSETS = (
    *((7, 0), (5, 6), (5, -6), (-7, 0), (-5, 6), (-5, -6)),
    *((0, 9), (0, -9), (8, 16), (8, -16), (-8, 16), (-8, -16)),
)
# Distance in pixels to the left and right edges: text may be wider at another resolution.
_EDGE = 16.0
# An obstacle: both ends in data coordinates, and half its width in pixels.
Obstacle = tuple[tuple[float, float], tuple[float, float], float]


def place_labels(
    axes: Any, labels: Sequence[tuple[float, float, str, str]], obstacles: Sequence[Obstacle]
) -> None:
    """Write every label (x, y, text, color) at the candidate offset with the least overlap."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.transforms import Bbox

    renderer = FigureCanvasAgg(axes.figure).get_renderer()
    axes.figure.draw_without_rendering()
    occupied = []
    for first, second, half_width in obstacles:
        ends = axes.transData.transform((first, second))
        occupied.append(Bbox([ends.min(axis=0), ends.max(axis=0)]).padded(half_width))
    frame = axes.get_window_extent(renderer).padded(-_EDGE, 0.0)
    for x, y, text, color in labels:
        note = axes.annotate(text, (x, y), (0, 0), textcoords="offset points", fontsize=_SIZE, color=color)

        def box_at(offset: tuple[int, int], note: Any = note) -> Any:
            note.xyann = offset
            horizontal, vertical = (int(np.sign(o)) for o in offset)
            note.set(ha=("center", "left", "right")[horizontal], va=("center", "bottom", "top")[vertical])
            return note.get_window_extent(renderer)

        def overlap(offset: tuple[int, int]) -> float:
            box = box_at(offset)
            outside = box.width * box.height - _area(Bbox.intersection(box, frame))
            return round(outside + sum(_area(Bbox.intersection(box, other)) for other in occupied), 6)

        occupied.append(box_at(min(_OFFSETS, key=overlap)))
        # Otherwise constrained layout would shrink the axes for the label.
        note.set_in_layout(False)


def _area(box: Any) -> float:
    return 0.0 if box is None else float(box.width * box.height)
