"""The page of a cost study and its plots."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

from PIL import Image

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.measurement import Measurement
from mbtf_pipeline.cost.page import write_page
from mbtf_pipeline.cost.study import Study
from mbtf_pipeline.report.plots import Series, plot

DESCRIPTION = {
    "name": "a study", "machine": {"system": "a machine"}, "date": "today", "time": 600.0, "taken": 273.0,
    "material": "rock", "command": "mbtf-pipeline cost rock",
}  # fmt: skip


def measured(study: str, seconds: float, error: float, series: str = "neumip") -> Measurement:
    """A run as a study reports it."""
    details = {
        "queries": 1e6, "spp": 4.0, "generation_seconds": 3.0, "training_seconds": seconds,
        "training_steps": 700.0,
        "total_seconds": seconds + 4.0, "evaluation_ms_1080p": 250.0, "bytes": 1e6, "seeds": 2.0,
        "test_error": 0.02, "overhead_seconds": 1.0, "evaluating_seconds": 2.0,
    }  # fmt: skip
    estimates = Estimate(seconds, 0.0, 1), Estimate(error, 0.01, 9)
    command = "mbtf-gen a && mbtf-fit b"
    return Measurement(study, series, f"{seconds:g} s", command, *estimates, details=details)


def test_plots_are_also_opaque_pngs_with_labels_and_the_front(tmp_path: Path) -> None:
    cloud = Series("a", [1.0, 10.0], [0.5, 0.1], [0.02, 0.5], [0.1, math.inf], ["first", "second"], "points")
    svg = plot([cloud], "seconds", "error", "a plot", front=[(1.0, 0.5)], png=tmp_path / "a.png")
    assert all(text in svg for text in ("first", "second", "Pareto front"))
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.convert("RGBA").getpixel((1, 1)) == (255, 255, 255, 255)


def test_an_undefined_error_is_shown_as_such(tmp_path: Path) -> None:
    """Test values whose variance is not significant leave no unexplained variance."""
    page = write_page(Study(tmp_path, DESCRIPTION, [measured("run", 10.0, math.nan)])).read_text()
    assert not re.search(r"\b(nan|inf)\b", page)
    assert "No unexplained variance of test queries could be measured" in page


def test_one_run_is_an_answer_without_a_front(tmp_path: Path) -> None:
    """Neither has a comparison of one configuration a plot."""
    run, paths = measured("run", 10.0, 0.3), measured("paths", 1.0, 0.3)
    study = Study(tmp_path, DESCRIPTION, [paths, run], skipped=["paths, 8 paths"], least=131.0)
    page = write_page(study).read_text()
    assert list(tmp_path.glob("*.png")) == []
    assert "planned for 10:00 and took 4:33" in page
    assert "One complete run was measured" in page
    assert page.count("Pareto front") == 1
    assert "<td>700</td>" in page
    assert 'id="paths"' not in page
    assert '<td>0:10</td><td class="text">0.300 ± 0.010</td>' in page
    assert "Too few complete runs for a forecast: repeat the same command; it keeps" in page
    assert "Not measured: 1 configuration, for" in page
    study.measurements[1] = replace(run, curve=((6.0, 0.5), (8.0, 0.4)))
    study.description = {**DESCRIPTION, "time": 60.0}
    page = write_page(study).read_text()
    assert list(tmp_path.glob("*.png")) == []
    assert "repeat the command with --time 140s;" in page


def test_forecasts_are_marked_as_such(tmp_path: Path) -> None:
    found = [measured("run", seconds, 2.0 * seconds**-0.7) for seconds in (10.0, 20.0, 40.0)]
    page = write_page(Study(tmp_path, DESCRIPTION, found, skipped=["a", "b"])).read_text()
    rows = page.split('id="answers"')[1].split("</section>")[0].split("<tr")[2:]
    for mark in ("class=forecast", "forecast, "):
        assert [mark in row for row in rows] == [False] * 3 + [True] * 2
    assert "forecast, 95% interval" in page
    assert "Not measured: 2 configurations, for" in page


def test_the_page_shows_the_front_with_commands_and_what_is_biased(tmp_path: Path) -> None:
    def limited(name: str, bias: Estimate) -> Measurement:
        noise = Estimate(0.5, 0.01, 9)
        estimates = Estimate(1.0, 0.1, 4), noise, bias, noise
        return Measurement("interactions", "", name, "mbtf-gen c", *estimates)

    found = [
        measured("run", 10.0, 0.3), measured("run", 20.0, 0.2), measured("run", 20.0, 0.4, "other"),
        limited("1 interactions", Estimate(0.05, 0.004, 9)),
        limited("2 interactions", Estimate(0.002, 0.003, 9)), limited("no limit", Estimate(0.0, 0.0, 9)),
    ]  # fmt: skip
    study = Study(tmp_path, DESCRIPTION, found, deviation=Estimate(0.04, 0.01, 9))
    page = write_page(study).read_text()
    pictures = {"front", "interactions"}
    assert {p.stem for p in tmp_path.glob("*.png")} == pictures
    front = page.split('id="front"')[1].split("</section>")[0]
    # Two of the three runs, each with a command that one click selects.
    command = "<code>mbtf-gen a &amp;&amp; mbtf-fit b</code></td></tr>"
    # In a row of its own, so that the table fits narrow windows.
    assert front.count(f"<tr class=command><td class=command colspan=10>{command}") == 2
    assert "<th>command</th>" not in page
    assert front.count("<td>700</td>") == 2
    assert "<details>" not in front
    section = page.split('id="interactions"')[1].split("</section>")[0]
    # A significant bias with its error, and one that is not.
    for cell in ("<td>5.0 ± 0.4</td>", "not significant (0.2 ± 0.3)</td>"):
        assert cell in section
    assert "at most 0.6% of the mean value" in section
    assert "one run is 4.0 ± 1.0%" in page
    assert not re.search(r"\bnan\b", page)


def test_the_page_warns_of_other_work(tmp_path: Path) -> None:
    for share, warns in ((0.5, True), (0.97, False)):
        run = measured("run", 10.0, 0.3)
        run = replace(run, details={**run.details, "processor_share": share})
        page = write_page(Study(tmp_path, DESCRIPTION, [run])).read_text()
        assert (
            "Other work left 50% of the processors to this study: its times are up to 2.0 times" in page
        ) == warns
