"""Names beside points of a plot, placed so that they lie on no other name and no point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

_SIZE = 7.5
# Where a name may stand: offset in points from its point, and how it is aligned there.
_PLACES = (
    (7, 0, "left", "center"),
    (5, 6, "left", "bottom"),
    (5, -6, "left", "top"),
    (-7, 0, "right", "center"),
    (-5, 6, "right", "bottom"),
    (-5, -6, "right", "top"),
    (0, 9, "center", "bottom"),
    (0, -9, "center", "top"),
    (8, 16, "left", "bottom"),
    (8, -16, "left", "top"),
    (-8, 16, "right", "bottom"),
    (-8, -16, "right", "top"),
)
# Half the side of the square that a marker takes, in pixels at the figure's resolution.
_MARKER = 5.0
# How far names stay from the sides: they may come out wider at another resolution, for small letters are
# fitted to pixels.
_ROOM = 16.0
# Half the width that a line takes.
_LINE = 1.5


@dataclass(frozen=True)
class Named:
    """A point (x, y) in the data's units with its name and color."""

    x: float
    y: float
    name: str
    color: str


def place_names(
    figure: Any,
    axes: Any,
    named: Sequence[Named],
    points: Sequence[tuple[float, float]],
    lines: Sequence[tuple[tuple[float, float], tuple[float, float]]] = (),
) -> None:
    """Write names beside their points.

    Each takes the first of some places about its point that overlaps nothing, or the one that overlaps least.

    Parameters
    ----------
    points : of the whole plot, in the data's units
    lines : upright and level ones that names should not cross, by their ends
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.transforms import Bbox

    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    taken = [
        Bbox([[x - _MARKER, y - _MARKER], [x + _MARKER, y + _MARKER]])
        for x, y in (axes.transData.transform(p) for p in points)
    ]
    for ends in lines:
        (x0, y0), (x1, y1) = (axes.transData.transform(end) for end in ends)
        taken.append(
            Bbox([[min(x0, x1) - _LINE, min(y0, y1) - _LINE], [max(x0, x1) + _LINE, max(y0, y1) + _LINE]])
        )
    frame = axes.get_window_extent(renderer).padded(-_ROOM, 0.0)
    for one in named:
        best, least = None, float("inf")
        for dx, dy, side, height in _PLACES:
            text = axes.annotate(
                one.name,
                (one.x, one.y),
                (dx, dy),
                textcoords="offset points",
                fontsize=_SIZE,
                color=one.color,
                ha=side,
                va=height,
            )
            box = text.get_window_extent(renderer)
            overlap = sum(_area(Bbox.intersection(box, other)) for other in taken)
            overlap += box.width * box.height - _area(Bbox.intersection(box, frame))
            if overlap < least - 1e-9:
                if best is not None:
                    best[0].remove()
                best, least = (text, box), overlap
            else:
                text.remove()
            if least <= 1e-9:
                break
        assert best is not None
        # A name takes part in no layout: constrained layout would shrink the axes for it.
        best[0].set_in_layout(False)
        taken.append(best[1])


def _area(box: Any) -> float:
    return 0.0 if box is None else float(box.width * box.height)
