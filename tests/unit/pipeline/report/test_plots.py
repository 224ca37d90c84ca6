"""Labels, legends and axes of plots."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from mbtf_pipeline.report.labels import place_labels


def test_labels_keep_away_from_marks_and_from_each_other() -> None:
    """About points under a line, beside a bar and at the right edge."""
    axes = Figure(figsize=(6, 4), dpi=100).add_subplot()
    axes.set(xlim=(0, 10), ylim=(0, 10))
    at = [(2.0, 5.0), (2.3, 5.0), (9.9, 8.0)]
    axes.plot([0, 10], [5.3, 5.3])
    axes.errorbar([5.0], [4.6], xerr=[2.8])
    labels = [axes.annotate("a label", p, (6, 5), textcoords="offset points") for p in at]
    place_labels(axes, labels)
    boxes = [label.get_window_extent() for label in labels]
    frame = axes.get_window_extent()
    for number, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:number])
        assert box.x1 <= frame.x1
        for x, y in ((np.linspace(0, 10, 500), 5.3), (np.linspace(2.2, 7.8, 300), 4.6)):
            points = axes.transData.transform(np.stack([x, np.full_like(x, y)], -1))
            assert not any(box.contains(*point) for point in points)
