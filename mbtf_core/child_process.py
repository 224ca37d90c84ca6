"""Run a function in a child process that may abort or hang, and report in one line how it ended.

Compilers and drivers may crash the process, so they are tried in a child first.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# Marks the child's answers among whatever libraries print.
_MARK = "@mbtf-answer "

_CODE = f"""
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from importlib import import_module
def say(answer):
    sys.stdout.write("\\n" + {_MARK!r} + json.dumps(answer) + "\\n")
    sys.stdout.flush()
try:
    for answer in getattr(import_module(sys.argv[2]), sys.argv[3])(*sys.argv[4:]):
        say(answer)
    say(dict(finished=True))
except Exception as error:
    text = " ".join(str(getattr(error, "what", error)).split())
    say(dict(fault=text or type(error).__name__))
"""


@dataclass(frozen=True)
class Outcome:
    """How a child ended.

    Attributes
    ----------
    answers : what the function yielded, merged in order
    fault : why it did not finish, in one line; empty when it did
    seconds : wall time, start of the interpreter included
    """

    answers: dict[str, Any]
    fault: str
    seconds: float


def run_child(
    module: str, function: str, *arguments: str, timeout: float, environment: Mapping[str, str] | None = None
) -> Outcome:
    """Call ``module.function(*arguments)`` in a fresh interpreter.

    Parameters
    ----------
    function : a generator of JSON objects; the message of an exception becomes the fault
    timeout : seconds after which the child is killed
    environment : variables set for the child on top of this process's own
    """
    path = json.dumps([entry or os.getcwd() for entry in sys.path])
    start = time.monotonic()
    code: int | None = None
    try:
        done = subprocess.run(
            [sys.executable, "-c", _CODE, path, module, function, *arguments],
            check=False,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env={**os.environ, **(environment or {})},
            timeout=timeout,
        )
        output, noise, code = done.stdout, done.stderr, done.returncode
    except subprocess.TimeoutExpired as late:
        output, noise = late.stdout or b"", b""
    answers: dict[str, Any] = {}
    for line in output.decode(errors="replace").splitlines():
        if line.startswith(_MARK):
            answers |= json.loads(line.removeprefix(_MARK))
    finished = answers.pop("finished", False)
    fault = answers.pop("fault", "")
    if code is None:
        fault = f"no answer within {timeout:.0f} s"
    elif not finished and not fault:
        signals = {int(s): s.name for s in signal.Signals}
        ending = (
            f"ended by {signals.get(-code, f'signal {-code}')}"
            if code < 0
            else f"ended with exit code {code}"
        )
        last = [line.strip() for line in noise.decode(errors="replace").splitlines() if line.strip()][-1:]
        fault = f"the process was {ending}" + (f" ({last[0][:200]})" if last else "")
    return Outcome(answers, fault, time.monotonic() - start)
