"""Tables of the report: errors by group, errors over training time, and rates of evaluation."""

from __future__ import annotations

from typing import Any

import pytest

from mbtf_pipeline.compare import timing
from mbtf_pipeline.report.sections import error_context


def number(value: float, error: float) -> dict[str, Any]:
    return {"value": value, "error": error, "n": 50}


def test_errors_of_groups_are_marked_one_by_one() -> None:
    close = {"n": 50, "unexplained": number(0.11, 0.06), "mse": number(2e-4, 0.9e-4)}
    clear = {"n": 50, "unexplained": number(0.2, 0.01), "mse": number(4e-4, 1e-5)}
    unknown = {"n": 50, "unexplained": {"value": None, "error": None, "n": 50}, "mse": number(4e-4, 1e-5)}
    split = {**clear, "levels": {"0": close, "1": clear, "2": unknown}, "elevations": {"0.2-0.4": clear}}
    error = {"psnr": number(30, 1), "mse": number(1e-4, 1e-6), "relative_mse": number(0.1, 0.01)}
    flip = {"ldr": 0.1, "hdr": 0.2}
    direction = {"elevation": 45, "azimuth": 0}
    picture: dict[str, Any] = {"view": direction, "light": direction, "tiles_across": 1}
    picture["references"] = {"query": {"flip": flip}}
    picture["fits"] = {"a": {"errors": {"query": error}, "flip": flip}}
    steps = dict.fromkeys(("network_weights", "texels", "training_steps"), 9)
    test = {"a": {"splits": {"test": split}, "training_seconds": 3.0, **steps}}
    record: dict[str, Any] = {"fits": ["a"], "kinds": ["query"], "exposure": 0.0, "white": 1.0}
    record |= {"definitions": {}}
    record |= {"pictures": [picture], "test": test}
    context = error_context(record)
    levels, cosines = (table["rows"] for table in context["group_tables"])
    # What tells nothing is left out.
    assert levels == [
        ["0", "50", "not significant (0.11 ± 0.06)", "0.20 ± 0.09"],
        ["1", "50", "0.200 ± 0.010", "0.400 ± 0.010"],
    ]
    assert cosines[0][0] == "0.2–0.4"
    assert context["error_table"]["rows"][0][0] == "a (9 steps: not converged)"
    split["elevations"] = {"0.2-0.4": unknown}
    assert len(error_context(record)["group_tables"]) == len(error_context(record)["error_plots"]) == 1


def test_the_warm_up_and_an_outlier_do_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    now, costs = [0.0], iter([9.0, 0.1, 3.0, 0.2])

    def work() -> str:
        now[0] += next(costs)
        return "value"

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    value, seconds = timing.timed(work)
    assert value == "value"
    assert seconds == pytest.approx(0.2)
