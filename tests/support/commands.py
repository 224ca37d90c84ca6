"""Command lines of ``mbtf-gen`` in child processes: many in one, because the renderer starts slowly."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

# Runs each command line as the program's entry point does, with its output kept apart.
_CODE = """
import contextlib, io, json, sys
from mbtf_gen.cli.app import app
from mbtf_core.console import run
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


def start(line: Sequence[object], folder: Path) -> subprocess.Popen[str]:
    """Start ``mbtf-gen`` itself in `folder`."""
    return subprocess.Popen(
        [sys.executable, "-m", "mbtf_gen", *(str(word) for word in line)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "COLUMNS": "100"},
    )


def finished(process: subprocess.Popen[str]) -> Done:
    """Wait for a started program."""
    out, err = process.communicate(timeout=300)
    return Done(process.returncode, out, err)
