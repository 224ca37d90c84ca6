"""Command lines of ``mbtf-gen`` in child processes: many in one, because the renderer starts slowly."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
