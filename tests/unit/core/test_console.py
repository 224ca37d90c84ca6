"""Exit codes, messages, JSON and progress of the command lines."""

from __future__ import annotations

import json
import logging
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from mbtf_core.app.console import CONSOLE, Console, new_app, run
from mbtf_core.errors import EngineError, InputError, MbtfError, PartialError, UsageError


@pytest.fixture
def app() -> App:
    """A program with a default command and two named ones, which print what they were given."""
    app = new_app("prog", "A program.")

    @app.default
    def make(
        source: Path, /, *, queries: str = "4", size: tuple[int, int] = (1, 1), console: Console = CONSOLE
    ) -> None:
        print("make", source, queries, size, console.json)

    @app.command
    def plan(source: Path, /, *, depth: int = 6, deep: bool = False, console: Console = CONSOLE) -> None:
        print("plan", source, depth, deep, console.json)

    @app.command
    def doctor(*, code: int = 0, console: Console = CONSOLE) -> int:
        console.report({"code": code}, f"code {code}")
        return code

    return app


def failing(error: BaseException) -> App:
    app = new_app("prog", "A program.")

    @app.default
    def fail(console: Console = CONSOLE) -> None:
        raise error

    return app


@pytest.mark.parametrize(
    ("error", "text", "code"),
    [
        (InputError("is empty", where="a.npy", hint="fill it"), "a.npy: is empty; fill it", 3),
        (PartialError("2 of 3 failed"), "2 of 3 failed", 4),
        (KeyboardInterrupt(), "interrupted; run the same command again", 130),
        (OSError(28, "No space left on device"), "No space left on device", 3),
    ],
)
def test_json_is_one_object_on_failure(
    error: BaseException, text: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    app = new_app("prog", "A program.")

    @app.default
    def fail(*, after: bool = False, console: Console = CONSOLE) -> None:
        if after:
            console.report({"done": 1}, "done")
        raise error

    assert run(app, ["--json"]) == code
    assert json.loads(capsys.readouterr().out) == {"error": text, "exit_code": code}
    # A command that fails after its result prints no second object.
    assert run(app, ["--json", "--after"]) == code
    assert json.loads(capsys.readouterr().out) == {"done": 1}
    assert run(app, []) == code
    assert capsys.readouterr().out == ""


def test_json_takes_arrays_paths_and_missing_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    array, number, count = np.array([[1.5, math.nan]], np.float32), np.float32(0.25), np.int64(3)
    data = {"array": array, "number": number, "count": count, "infinite": math.inf}
    data |= {"path": Path("a/b"), "rows": (1, 2), "flag": True}
    Console(json=True).report(data, "text")
    found = json.loads(capsys.readouterr().out)
    assert found == {
        **{"array": [[1.5, None]], "number": 0.25, "count": 3, "infinite": None},
        **{"path": "a/b", "rows": [1, 2], "flag": True},
    }


@pytest.mark.parametrize(
    ("error", "code"), [(UsageError, 2), (InputError, 3), (EngineError, 3), (PartialError, 4), (MbtfError, 1)]
)
def test_errors_are_two_lines(error: type[MbtfError], code: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(failing(error("is torn", where="a.exr", hint="repair it")), []) == code
    captured = capsys.readouterr()
    assert captured.err == "error: a.exr: is torn\n  repair it\n"
    assert captured.out == ""


@pytest.mark.parametrize("line", ["doctr", "--json doctor", "doctr --code 3", "--json doctor more"])
def test_a_line_that_fails_suggests_the_command_that_it_may_mean(
    app: App, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    app.default_command = None

    @app.default
    def read(source: Path, /, *, code: int = 0, console: Console = CONSOLE) -> None:
        raise InputError("no such file", where=source)

    assert run(app, line.split()) == 2
    assert "did you mean: prog doctor" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted\n  run the same command again"),
        (FileNotFoundError(2, "No such file", "/no/map"), 3, "/no/map: No such file"),
        (
            ModuleNotFoundError("No module named 'torch'", name="torch"),
            3,
            "the Python package 'torch' is missing\n  run: mbtf-gen doctor",
        ),
        (
            ZeroDivisionError("first\nsecond"),
            1,
            "internal error: ZeroDivisionError: first second (run again with --debug for the traceback)",
        ),
    ],
)
def test_other_errors_are_short(
    error: BaseException, code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(failing(error), []) == code
    assert capsys.readouterr().err == f"error: {message}\n"


@pytest.mark.parametrize("error", [InputError("torn"), ZeroDivisionError("x"), KeyboardInterrupt()])
def test_debug_shows_the_traceback(error: BaseException, capsys: pytest.CaptureFixture[str]) -> None:
    run(failing(error), [])
    assert "Traceback" not in capsys.readouterr().err
    run(failing(error), ["--debug"])
    assert "Traceback" in capsys.readouterr().err


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
        bar.update(0, "reading the data")
        now = 30.0
        bar.update(0, "training")
        now = 45.0
        bar.update(50.0, "loss 3")
        now = 60.0
        bar.update(65.0, "loss 2")
        now = 95.0
        bar.update(100, "loss 1")
        bar.update(100, "evaluating")
        bar.update(100, "evaluating")
        now = 96.0
        bar.update(100, "writing")
    assert capsys.readouterr().err.splitlines() == [
        "fitting: 0%, 0:00 elapsed, reading the data",
        "fitting: 0%, 0:30 elapsed, training",
        "fitting: 50%, 0:45 elapsed, loss 3",
        "fitting: 65%, 1:00 elapsed, 0:35 left, loss 2",
        "fitting: 100%, 1:35 elapsed, loss 1",
        "fitting: 100%, 1:35 elapsed, evaluating",
        "fitting: 100%, 1:36 elapsed, writing",
    ]


def test_plain_progress_has_a_line_at_intervals(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr("mbtf_core.app.progress.time.monotonic", lambda: now)
    with CONSOLE.progress(100, "fitting", "steps") as bar:
        for step in range(25):
            now += 1
            bar.advance(2, f"step {step}")
    with CONSOLE.progress(None, "reading", "rows") as bar:
        bar.update(7)
    with CONSOLE.progress(4, "rendering", "shards"):
        pass
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [
        "fitting: 20/100 steps (20%), 0:10 elapsed, 0:40 left, step 9",
        "fitting: 40/100 steps (40%), 0:20 elapsed, 0:30 left, step 19",
        "fitting: 50/100 steps (50%), 0:25 elapsed, 0:25 left, step 24",
        "reading: 7 rows, 0:00 elapsed",
    ]
    assert captured.out == ""


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
def test_progress_on_a_terminal_is_a_bar() -> None:
    import os
    import pty
    import subprocess

    note = "loss 0.123, unexplained 0.250 ± 0.010, 1.23 M queries/s"
    code = "from mbtf_core.app.console import CONSOLE\n"
    code += f"with CONSOLE.progress(3, 'rendering') as bar: bar.advance(3, {note!r})"
    reader, writer = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "60"}
    subprocess.run([sys.executable, "-c", code], stderr=writer, env=environment, check=True)
    os.close(writer)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", os.read(reader, 65536).decode())
    os.close(reader)
    lines = [line.strip() for line in re.split(r"[\r\n]+", plain) if line.strip()]
    assert note in lines
    assert any("━" in line and "100%" in line for line in lines)
    assert all(re.match(r"rendering ━+ |loss ", line) and len(line) <= 60 for line in lines), lines
