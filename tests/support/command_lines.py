"""Command lines of the three programs in this process."""

from __future__ import annotations

import contextlib
import io
import logging

from mbtf_core.app.console import run

from .commands import Done


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
