"""Command lines: of the three programs in this process, or many of ``mbtf-gen`` in one child process."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mbtf_core.app.console import run

# Runs each command line as the program's entry point does, with its output kept apart.
_CODE = """
import contextlib, io, json, sys
from mbtf_gen.cli.app import app
from mbtf_core.app.console import run
answers = []
for line in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(app, line)
    answers.append([code, out.getvalue(), err.getvalue()])
json.dump(answers, sys.stdout)
"""


@dataclass(frozen=True)
class Done:
    """What a command line did: exit code, standard output, standard error."""

    code: int
    out: str
    err: str

    def result(self) -> dict[str, Any]:
        """The JSON object that a successful command printed."""
        assert self.code == 0, self.err
        parsed = json.loads(self.out)
        assert isinstance(parsed, dict)
        return parsed


def run_all(lines: Sequence[Sequence[object]], folder: Path) -> list[Done]:
    """Run command lines (without the program's name) one after another in one child, in `folder`."""
    child = subprocess.run(
        [sys.executable, "-c", _CODE],
        input=json.dumps([[str(word) for word in line] for line in lines]),
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=300,
        check=False,
    )
    assert child.returncode == 0, child.stderr
    return [Done(*answer) for answer in json.loads(child.stdout)]


def run_named(lines: Mapping[str, str], folder: Path) -> dict[str, Done]:
    """:func:`run_all` of command lines by name, as one types them."""
    return dict(zip(lines, run_all([line.split() for line in lines.values()], folder), strict=True))


def call(words: list[str]) -> Done:
    """Run a command line of one of the programs in this process, in the current folder."""
    import mbtf_fit.cli.app
    import mbtf_gen.cli.app
    import mbtf_pipeline.cli.app

    program, *tokens = words
    modules = {
        "mbtf-gen": mbtf_gen.cli.app,
        "mbtf-fit": mbtf_fit.cli.app,
        "mbtf-pipeline": mbtf_pipeline.cli.app,
    }
    loggers = [logging.getLogger(name) for name in ("mbtf_core", "mbtf_gen", "mbtf_fit", "mbtf_pipeline")]
    before = [(logger, logger.handlers, logger.propagate, logger.level) for logger in loggers]
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = run(modules[program].app, tokens)
    finally:
        for logger, handlers, propagate, level in before:
            logger.handlers, logger.propagate = handlers, propagate
            logger.setLevel(level)
    return Done(code, out.getvalue(), err.getvalue())


def fails(code: int, *arguments: str) -> str:
    """Error message of a failing ``mbtf-fit``: at most two lines, no traceback, no standard output."""
    done = call(["mbtf-fit", *arguments])
    assert done.code == code, done.err
    assert done.out == ""
    start = done.err.index("error: ")
    assert len(done.err[start:].splitlines()) <= 2, done.err
    assert "Traceback" not in done.err
    return done.err[start:]
