"""Tables of the report: errors by group, errors over training time, and rates of evaluation."""

from __future__ import annotations

from typing import Any

import pytest

from mbtf_pipeline.compare import timing
from mbtf_pipeline.report.errors import error_context, group_label
from mbtf_pipeline.report.times import _comparison, _fits
from mbtf_pipeline.report.training import TrainingHistory


@pytest.mark.parametrize(
    ("name", "label"), [("4", "4"), ("0-0.2", "0–0.2"), ("0.2-0.4", "0.3–0.4"), ("0.4-0.7", "0.4–0.7")]
)
def test_ranges_of_cosines_start_at_the_smallest_in_the_data(name: str, label: str) -> None:
    assert group_label(name, 0.3) == label


def number(value: float, error: float) -> dict[str, Any]:
    return {"value": value, "error": error, "n": 50}


def test_both_errors_of_a_group_are_significant_or_neither() -> None:
    close = {"n": 50, "unexplained": number(0.11, 0.06), "mse": number(2e-4, 0.9e-4)}
    clear = {"n": 50, "unexplained": number(0.2, 0.01), "mse": number(4e-4, 1e-5)}
    split = {**clear, "levels": {"0": close, "1": clear}, "elevations": {"0.2-0.4": clear}}
    error = {"psnr": number(30, 1), "mse": number(1e-4, 1e-6), "relative_mse": number(0.1, 0.01)}
    flip = {"ldr": 0.1, "hdr": 0.2}
    direction = {"elevation": 45, "azimuth": 0}
    picture: dict[str, Any] = {"view": direction, "light": direction, "tiles_across": 1}
    picture["references"] = {"query": {"flip": flip}}
    contrast = {"query": {"luminance": number(0.95, 0.02), "chroma": None, "correlation": None}}
    picture["fits"] = {"a": {"errors": {"query": error}, "flip": flip, "contrast": contrast}}
    test = {"a": {"splits": {"test": split}, "network_weights": 9, "texels": 9}}
    record: dict[str, Any] = {
        "fits": ["a"],
        "kinds": ["query"],
        "exposure": 0.0,
        "white": 1.0,
        "definitions": {},
    }
    shown = {"a": number(1.1, 0.01)}
    phases = [{"level": 3, "phase": phase, "fits": shown} for phase in ("centers", "corners")]
    record |= {"pictures": [picture], "test": test, "phases": phases}
    context = error_context(record, 0.3)
    levels, cosines = (table["rows"] for table in context["group_tables"])
    assert levels[0] == ["0", "50", "not significant (11 ± 6 %)", "not significant (0.20 ± 0.09)"]
    assert levels[1] == ["1", "50", "20.0 ± 1.0 %", "0.400 ± 0.010"]
    assert cosines[0][0] == "0.3–0.4"
    assert context["facts"][0]["value"] == "20.0 ± 1.0 %"
    # Of a gray material there is no chroma.
    assert context["contrast_table"]["rows"][0][3:] == ["a", "0.95 ± 0.02", "–", "–"]
    assert context["phase_table"]["rows"] == [["3", "a", "1.100 ± 0.010", "1.100 ± 0.010"]]


def test_errors_over_training_time_have_error_bars() -> None:
    rows = [(10.0, 0.5, 0.01), (50.0, 0.4, 0.03), (90.0, 0.039, 0.069)]
    records = [{"seconds": s, "loss": 1.0, "unexplained": v, "unexplained_error": e} for s, v, e in rows]
    # Records without a validation are skipped.
    training = {"steps": 1000, "batch": 4096, "seconds": 100.0}
    history = TrainingHistory(training, [*records, {"seconds": 95.0, "loss": 1.0}])
    cells = _fits({"a": history})["rows"][0]
    assert cells[-4] == "0.500 ± 0.010 at 10 s"
    assert cells[-1] == "not significant (0.04 ± 0.07) at 90 s"


def test_one_slow_image_does_not_change_the_rate() -> None:
    references = {"query": {"noise": number(0.1, 0.01)}}
    pictures = [{"fits": {"a": {"seconds": s}}, "references": references} for s in (0.04, 3.07, 0.04)]
    record = {"size": 200, "spp": 4, "fits": ["a"], "kinds": ["query"], "pictures": pictures}
    row = _comparison(record | {"seconds": {"references": 1.0}})["rows"][1]
    assert row == ["a", "3.15", "1.00 M queries/s", "median 40 ms per image"]


def test_the_warm_up_and_an_outlier_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    now, costs = [0.0], iter([9.0, 0.1, 3.0, 0.2])

    def work() -> str:
        now[0] += next(costs)
        return "value"

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    value, seconds = timing.timed(work)
    assert value == "value"
    assert seconds == pytest.approx(0.2)
