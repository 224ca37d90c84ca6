"""Threads that Mitsuba renders with on a worker."""

from __future__ import annotations

import os
import subprocess
import sys

from mbtf_core.run.task import THREADS_VARIABLE

SHOWN = """
from mbtf_gen.engine.runtime import load_mitsuba
load_mitsuba()
import drjit
print(drjit.thread_count())
"""


def test_a_worker_renders_with_its_threads() -> None:
    environment = {**os.environ, THREADS_VARIABLE: "3"}
    shown = subprocess.run([sys.executable, "-c", SHOWN], env=environment, capture_output=True, text=True)
    assert shown.stdout.split() == ["3"], shown.stderr
