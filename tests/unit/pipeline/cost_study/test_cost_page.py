"""What a cost study shows: its page, its plots."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from PIL import Image

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost_study.figures import chain_name
from mbtf_pipeline.cost_study.fit_runs import QUALITIES
from mbtf_pipeline.cost_study.measurements import Point, PointFolder

DESCRIPTION = {
    "name": "a study", "machine": {"system": "a machine"}, "made": "today", "budget": 600.0,
    "material": "rock", "command": "mbtf-pipeline cost rock",
}  # fmt: skip


def made(study: str, seconds: float, error: float, series: str = "neumip", **details: float) -> Point:
    """A chain's point as the workshop makes it."""
    numbers = {
        "queries": 1e6, "spp": 4.0, "generation_seconds": 3.0, "training_seconds": seconds,
        "total_seconds": seconds + 4.0, "evaluation_ms_1080p": 250.0, "bytes": 1e6, "half_bytes": 5e5,
        "half_error": error * 1.01, "half_error_se": 0.01,
    }  # fmt: skip
    spent, left = Estimate(seconds, 0.0, 1), Estimate(error, 0.01, 9)
    return Point(
        study, series, f"{seconds:g} s", {}, "mbtf-gen a && mbtf-fit b", spent, left, details=numbers
    )


def test_plots_name_their_axes_and_bars(tmp_path: Path) -> None:
    from mbtf_pipeline.report.plots import Cloud, scatter

    cloud: Any = Cloud("series", [1.0, 10.0], [0.5, 0.1], [0.1, 0.0], [0.02, 0.5], ["first", "second"])
    svg = scatter([cloud], "seconds", "error", "a plot", front=[(1.0, 0.5)], png=tmp_path / "a.png")
    for text in ("seconds", "error", "series", "first", "second", "front"):
        assert text in svg
    with Image.open(tmp_path / "a.png") as picture:
        # On white, whatever lies behind it.
        assert picture.convert("RGBA").getpixel((1, 1)) == (255, 255, 255, 255)


def test_a_legend_of_long_names_is_no_wider_than_the_figure() -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from mbtf_pipeline.report.plots import _legend_above

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    _legend_above(figure, [(axes.plot([0])[0], f"a name of some length, number {n}") for n in range(6)])
    (legend,) = figure.legends
    extent = legend.get_window_extent(FigureCanvasAgg(figure).get_renderer())
    assert extent.width <= figure.bbox.width
    assert len(legend.get_texts()) == 6


def test_every_line_of_a_study_has_a_color_and_a_mark_of_its_own() -> None:
    from mbtf_pipeline.cost_study.fit_runs import MODELS, SIZES
    from mbtf_pipeline.report.plots import COLORS, MARKERS

    assert 1 + len(MODELS) + len(SIZES) <= len(set(COLORS)) == len(set(MARKERS)) == len(COLORS)


def test_names_lie_on_no_point_and_on_no_other_name() -> None:
    """Points of a cluster, close enough that names beside them would cover each other."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from mbtf_pipeline.report.labels import Named, place_names

    figure = Figure(figsize=(7, 4))
    axes = figure.add_subplot()
    spots = [(0.5, 0.5), (0.52, 0.5), (0.54, 0.51), (0.95, 0.5)]
    axes.set(xlim=(0, 1), ylim=(0, 1))
    line = ((0.4, 0.5), (0.6, 0.5))
    place_names(figure, axes, [Named(*s, "a name of some length", "k") for s in spots], spots, [line])
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [t.get_window_extent(renderer) for t in axes.texts]
    assert len(boxes) == len(spots)
    for number, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:number])
        assert not any(box.contains(*axes.transData.transform(s)) for s in spots)
        # Letters at another resolution may be wider.
        assert box.x1 <= axes.get_window_extent(renderer).x1 - 0.02 * box.width
        ends = [axes.transData.transform(end) for end in line]
        across = box.x0 < ends[1][0] and box.x1 > ends[0][0]
        assert not (across and box.y0 < ends[0][1] < box.y1)


def test_what_could_not_be_told_is_kept_and_shown_as_such(tmp_path: Path) -> None:
    """Test values whose variance is not told from zero leave no error."""
    from mbtf_pipeline.cost_study.page import write_page
    from mbtf_pipeline.cost_study.study import Study

    store = PointFolder(tmp_path, {})
    unknown = made("fit", 10.0, math.nan)
    store.put({"n": 1}, unknown)
    found = store.get("fit", {"n": 1})
    assert found is not None
    assert math.isnan(found.error.value)
    assert math.isnan(found.details["half_error"])
    assert found.details["bytes"] == unknown.details["bytes"]
    page = write_page(Study(tmp_path, DESCRIPTION, [found], test_seconds=90.0)).read_text()
    assert not re.search(r"\b(nan|inf)\b", page)
    assert "No unexplained variance of test queries could be told" in page
    # Chains whose scatter is not known have bars that are too narrow.
    assert "too few seeds" in page
    assert "--narrow" not in page
    assert "for about 1:30 of tracing" in page
    summary = json.loads((tmp_path / "study.json").read_text())["summary"]
    assert (summary["known_to_a_tenth"], summary["known"], summary["scatter"]) == (0, 0, None)


def test_the_page_shows_the_front_with_commands_and_what_is_biased(tmp_path: Path) -> None:
    from mbtf_pipeline.cost_study.page import write_page
    from mbtf_pipeline.cost_study.study import Study

    def setting(name: str, bias: Estimate) -> Point:
        second, noise = Estimate(1.0, 0.1, 4), Estimate(0.5, 0.01, 9)
        return Point("bounces", "interactions", name, {}, "mbtf-gen c", second, noise, bias, noise)

    points = [
        made("fit", 10.0, 0.3), made("fit", 20.0, 0.2), made("fit", 20.0, 0.4, "neumip-baseline"),
        setting("1 interactions", Estimate(0.05, 0.004, 9)),
        setting("2 interactions", Estimate(0.002, 0.003, 9)), setting("no limit", Estimate(0.0, 0.0, 9)),
    ]  # fmt: skip
    page = write_page(Study(tmp_path, DESCRIPTION, points)).read_text()
    names = {p.stem for p in tmp_path.glob("*.png")}
    assert names == {"front", "fit", "fit_evaluation", "fit_bytes", "bounces"}
    front = page.split('id="front"')[1].split("</section>")[0]
    # Two of the three chains, in sight, each with a command that one click selects.
    assert front.count("<td class=command><code>mbtf-gen a &amp;&amp; mbtf-fit b</code></td>") == 2
    assert "<details>" not in front
    bounces = page.split('id="bounces"')[1].split("</section>")[0]
    # The bias that is told from zero has a bar, the other a limit, and what is the reference's own has none.
    assert "<td>5.0 ± 0.4 %</td>" in bounces
    assert "<td>&lt; 0.6 %</td>" in bounces
    assert "<td>0 %</td>" in bounces
    assert "at most 0.6 % of the mean value" in bounces
    assert not re.search(r"\bnan\b", page)


def test_chains_on_the_front_are_told_apart() -> None:
    five, error = Estimate(5.0, 0.0, 1), Estimate(0.2, 0.01, 9)

    def name(study: str, series: str) -> str:
        details = {"queries": 1.1e7, "spp": 4.0}
        return chain_name(Point(study, series, "17.8 s", {}, "", five, error, details=details))

    assert name("fit", QUALITIES) == name("data", "4 paths/query") == "11 M × 4"
    assert name("fit", "neumip") == "11 M × 4, neumip of its paper"
    assert name("fit", "neumip, 40 wide, 12 channels, z") == "11 M × 4, 40 wide, 12 channels, z"
