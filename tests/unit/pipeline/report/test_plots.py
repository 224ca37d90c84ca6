"""Plots are self-contained SVG elements in the page's text color, with unique ids and named axes."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from mbtf_pipeline.report.plots import Series, plot, points

SECONDS = list(np.linspace(2, 60, 30))
ERROR = [0.3 + 1 / s for s in SECONDS]


def training(label: str = "training") -> str:
    lines = [Series("first", SECONDS, ERROR, [0.01] * 30), Series("second", SECONDS, [2 * e for e in ERROR])]
    return plot(lines, "seconds of training", "unexplained variance", label, log="y")


def levels() -> str:
    series = {"first": [(0.1, 0.01), (0.2, 0.5), None], "second": [(0.3, 0.02), (-0.1, 0.2), (0.5, 0.1)]}
    return points(["0", "1", "2"], series, "level", "unexplained variance", "levels")


def texts(svg: str) -> set[str]:
    return {e.text for e in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text") if e.text}


@pytest.mark.parametrize(
    ("svg", "expected"),
    [
        (training(), {"seconds of training", "unexplained variance", "first", "second"}),
        (levels(), {"level", "unexplained variance", "first", "second", "0", "1", "2"}),
    ],
)
def test_plots_are_self_contained_and_name_axes_and_series(svg: str, expected: set[str]) -> None:
    assert expected <= texts(svg)
    without_names = re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", svg)
    assert "http" not in without_names
    assert "<metadata" not in svg
    assert "<?xml" not in svg
    assert "currentColor" in svg
    assert "#010203" not in svg
    references = re.findall(r'(?:href="|url\()#([^")]+)', svg)
    assert set(references) <= set(re.findall(r'\bid="([^"]+)"', svg))


def test_ids_are_unique_and_plots_are_reproducible() -> None:
    first, again, other = training("a plot"), training("a plot"), training("another")
    assert first == again
    ids = [set(re.findall(r'\bid="([^"]+)"', svg)) for svg in (first, other)]
    assert ids[0]
    assert not ids[0] & ids[1]
