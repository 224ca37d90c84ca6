"""Shared by all tests: reproducible hypothesis runs, and a way to run Python in a fresh process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable

import pytest
from hypothesis import settings

from mbtf_gen.engine.runtime import use_shipped_llvm

# Workers of a test run fill the processors by themselves; a second thread would spend its time waiting.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Tests import drjit at the top: before that, as load_mitsuba does, choose the LLVM of the installation.
use_shipped_llvm()

# The same examples in every run, and no limit on the time of one: neither machine nor luck decides a test.
settings.register_profile("project", derandomize=True, deadline=None)
settings.load_profile("project")


@pytest.fixture(autouse=True)
def ctrl_c_interrupts() -> None:
    """Python's own handler. A shell without job control starts background processes with the signal ignored;
    Mitsuba and dask-jobqueue leave handlers behind."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


RunPython = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="session")
def run_python() -> RunPython:
    """``run_python("-m", "mbtf_gen", …, KEY="value")`` in a fresh interpreter; None removes a variable."""

    def run(*arguments: str, **variables: str | None) -> subprocess.CompletedProcess[str]:
        environment = dict(os.environ)
        for name, value in variables.items():
            environment.pop(name, None)
            if value is not None:
                environment[name] = value
        return subprocess.run(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            env=environment,
            timeout=300,
            check=False,
        )

    return run
