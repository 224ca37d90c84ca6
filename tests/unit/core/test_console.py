"""Exit codes, messages, JSON and progress of the command lines."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from mbtf_core.app.console import CONSOLE, Console, new_app, run
from mbtf_core.errors import EngineError, InputError, MbtfError, PartialError, UsageError

KINDS = {UsageError: 2, InputError: 3, EngineError: 3, PartialError: 4, MbtfError: 1}


@pytest.fixture
def app() -> App:
    """A program whose default command does not find its file."""
    app = new_app("prog", "A program.")

    @app.default
    def read(source: Path, /, *, code: int = 0, console: Console = CONSOLE) -> None:
        raise InputError("no such file", where=source)

    @app.command
    def doctor(*, code: int = 0, console: Console = CONSOLE) -> int:
        return code

    return app


TORN = {"where": "a.exr", "hint": "repair it"}
DEBUG = "(run again with --debug for the traceback)"


@pytest.mark.parametrize(
    ("error", "code", "lines"),
    [
        *((kind("is torn", **TORN), code, "a.exr: is torn\n  repair it") for kind, code in KINDS.items()),
        (PartialError("2 of 3 failed"), 4, "2 of 3 failed"),
        (KeyboardInterrupt(), 130, "interrupted\n  run the same command again"),
        (FileNotFoundError(2, "No such file", "/no/map"), 3, "/no/map: No such file"),
        (
            ModuleNotFoundError(name="torch"),
            3,
            "the Python package 'torch' is missing\n  run: mbtf-gen doctor",
        ),
        (ZeroDivisionError("first\nsecond"), 1, f"internal error: ZeroDivisionError: first second {DEBUG}"),
    ],
)
def test_a_failure_is_one_or_two_lines_and_one_object_of_json(
    error: BaseException, code: int, lines: str, capsys: pytest.CaptureFixture[str]
) -> None:
    app = new_app("prog", "A program.")

    @app.default
    def fail(*, after: bool = False, console: Console = CONSOLE) -> None:
        if after:
            console.report({"done": 1}, "done")
        raise error

    assert run(app, []) == code
    assert capsys.readouterr() == ("", f"error: {lines}\n")
    run(app, ["--debug"])
    assert "Traceback" in capsys.readouterr().err
    assert run(app, ["--json"]) == code
    assert json.loads(capsys.readouterr().out) == {"error": lines.replace("\n  ", "; "), "exit_code": code}
    # A command that fails after its result prints no second object.
    assert run(app, ["--json", "--after"]) == code
    assert json.loads(capsys.readouterr().out) == {"done": 1}


def test_json_takes_arrays_paths_and_missing_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    array = np.array([[1.5, math.nan]], np.float32)
    Console(json=True).report(
        {"array": array, "count": np.int64(3), "infinite": math.inf, "path": Path("a")}, ""
    )
    expected = {"array": [[1.5, None]], "count": 3, "infinite": None, "path": "a"}
    assert json.loads(capsys.readouterr().out) == expected


@pytest.mark.parametrize("line", ["doctr", "--json doctor", "doctr --code 3", "--json doctor more"])
def test_a_line_that_fails_suggests_the_command_that_it_may_mean(
    app: App, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(app, line.split()) == 2
    assert "did you mean: prog doctor" in capsys.readouterr().err


def test_warnings_of_the_packages_reach_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    app = new_app("prog", "A program.")

    @app.default
    def warn(console: Console = CONSOLE) -> None:
        logging.getLogger("mbtf_gen.anything").info("mesh: 64 cells")
        logging.getLogger("mbtf_gen.anything").warning("8-bit heights were smoothed")
        logging.getLogger("mbtf_gen.anything").debug("detail")

    assert run(app, []) == 0
    assert capsys.readouterr().err == "mesh: 64 cells\nwarning: 8-bit heights were smoothed\n"
    assert run(app, ["--quiet"]) == 0
    assert capsys.readouterr().err == "warning: 8-bit heights were smoothed\n"


def test_the_time_left_counts_neither_set_up_nor_earlier_runs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("mbtf_core.app.progress.time.monotonic", lambda: now)
    with CONSOLE.progress(100, "fitting", "%") as bar:
        # Reading takes 30 s, the first step of a resumed fit compiles, then each percent takes a second.
        notes = "reading", "training", "loss 3", "loss 2"
        for now, done, note in zip((0.0, 30.0, 45.0, 60.0), (0, 0, 50, 65), notes, strict=True):  # noqa: B007
            bar.update(done, note)
        # Within an interval there is no line but the last.
        bar.update(66, "loss 1")
        bar.update(67, "loss 0")
    assert capsys.readouterr().err.splitlines() == [
        "fitting: 0%, 0:00 elapsed, reading",
        "fitting: 0%, 0:30 elapsed, training",
        "fitting: 50%, 0:45 elapsed, loss 3",
        "fitting: 65%, 1:00 elapsed, 0:35 left, loss 2",
        "fitting: 67%, 1:00 elapsed, 0:29 left, loss 0",
    ]
