"""Labels of points, where a plot has room for them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Distances of a label from its point, in typographic points, and the space around it, in pixels.
_NEAR, _FAR, _MARGIN = (7.0, 5.0), (14.0, 16.0), 2.0
# Pixels between the samples of a mark.
_STEP = 2.0
_PLACES = tuple(
    (side * dx, rise * dy)
    for dx, dy in (_NEAR, (_NEAR[0], _FAR[1]), _FAR, (_FAR[0], 2 * _FAR[1]))
    for rise, side in itertools.product((1, -1), (1, -1))
)


def place_labels(axes: Any, labels: Sequence[Any]) -> None:
    """Move annotations, whose positions are offsets in typographic points, to the first places about their
    points that cover least of lines, bars and labels. The matplotlib axes have all marks drawn, and their
    final limits."""
    if not labels:
        return
    axes.figure.draw_without_rendering()  # Lays the axes out.
    marks, frame = _marks(axes), axes.get_window_extent()
    for label in labels:
        costs = [_cost(_boxed(label, place), marks, frame) for place in _PLACES]
        box = _boxed(label, _PLACES[int(np.argmin(costs))])
        # Other labels keep away from this one.
        xs, ys = (np.arange(low, high, _STEP) for low, high in ((box.x0, box.x1), (box.y0, box.y1)))
        marks = np.concatenate([marks, np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)])


def _boxed(label: Any, place: tuple[float, float]) -> Any:
    """The extent of a label at an offset, in pixels."""
    label.set_position(place)
    label.set_horizontalalignment("left" if place[0] > 0 else "right")
    label.set_verticalalignment("bottom" if place[1] > 0 else "top")
    return label.get_window_extent().padded(_MARGIN)


def _cost(box: Any, marks: NDArray[np.float64], frame: Any) -> float:
    """Samples of marks under a box, and pixels of it outside the frame."""
    covered = ((marks > (box.x0, box.y0)) & (marks < (box.x1, box.y1))).all(axis=1).sum()
    outside = np.maximum([frame.x0 - box.x0, frame.y0 - box.y0, box.x1 - frame.x1, box.y1 - frame.y1], 0.0)
    return float(covered + outside.sum())


def _marks(axes: Any) -> NDArray[np.float64]:
    """Samples (n, 2) of all lines and error bars of the axes, in pixels."""
    from matplotlib.collections import LineCollection

    # Steps are drawn between the points of a line, in its path alone.
    found = [(line, line.get_path().vertices, line.get_linestyle() != "None") for line in axes.lines]
    bars = [one for one in axes.collections if isinstance(one, LineCollection)]
    found += [(bar, segment, True) for bar in bars for segment in bar.get_segments()]
    samples = [np.empty((0, 2))]
    for mark, vertices, joined in found:
        ends = np.asarray(mark.get_transform().transform(vertices), float)
        ends = ends[np.isfinite(ends).all(axis=1)]
        samples.append(ends)
        for one, other in itertools.pairwise(ends) if joined else ():
            count = max(2, int(np.hypot(*(other - one)) / _STEP))
            samples.append(np.linspace(one, other, count))
    return np.concatenate(samples)
