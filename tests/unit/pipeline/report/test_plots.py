"""Plots are self-contained SVG elements in the page's text color, with unique ids and named axes."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np

from mbtf_pipeline.report.plots import Series, plot

SECONDS = list(np.linspace(2, 60, 30))
ERROR = [0.3 + 1 / s for s in SECONDS]


def training(label: str = "training") -> str:
    lines = [Series("first", SECONDS, ERROR, [0.01] * 30), Series("second", SECONDS, [2 * e for e in ERROR])]
    return plot(lines, "seconds of training", "unexplained variance", label, log="y")


def texts(svg: str) -> set[str]:
    return {e.text for e in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text") if e.text}


def test_plots_are_self_contained_reproducible_and_name_axes_and_series() -> None:
    svg = training()
    assert svg == training()
    assert {"seconds of training", "unexplained variance", "first", "second"} <= texts(svg)
    without_names = re.sub(r'\sxmlns(:xlink)?="[^"]*"', "", svg)
    assert "http" not in without_names
    assert "<metadata" not in svg
    assert "<?xml" not in svg
    assert "currentColor" in svg
    assert "#010203" not in svg
    references = re.findall(r'(?:href="|url\()#([^")]+)', svg)
    assert set(references) <= set(re.findall(r'\bid="([^"]+)"', svg))
