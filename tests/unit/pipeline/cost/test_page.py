"""The page of a cost study and its plots."""

from __future__ import annotations

import math
import re
from pathlib import Path

from mbtf_core.stats import Estimate
from mbtf_pipeline.cost.measurement import Measurement
from mbtf_pipeline.cost.page import write_page
from mbtf_pipeline.cost.study import Study

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


def test_an_undefined_error_is_shown_as_such(tmp_path: Path) -> None:
    """Test values whose variance is not significant leave no unexplained variance."""
    page = write_page(Study(tmp_path, DESCRIPTION, [measured("run", 10.0, math.nan)])).read_text()
    assert not re.search(r"\b(nan|inf)\b", page)
    assert "No unexplained variance of test queries could be measured" in page


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
    assert {p.stem for p in tmp_path.glob("*.png")} == {"front", "interactions"}
    # Two of the three runs, each with its command.
    assert page.count("<code>mbtf-gen a &amp;&amp; mbtf-fit b</code>") == 2
    section = page.split('id="interactions"')[1].split("</section>")[0]
    # A significant bias with its error, and one that is not.
    for cell in ("<td>5.0 ± 0.4</td>", "not significant (0.2 ± 0.3)</td>"):
        assert cell in section
