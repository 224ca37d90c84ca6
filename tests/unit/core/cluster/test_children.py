"""Tasks in processes of this machine, one after the other."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from support.paths import ROOT

from mbtf_core.cluster.children import run_in_children
from mbtf_core.cluster.task import Task

TASKS = "support.cluster_tasks"
COMMAND = f"""
import sys
from mbtf_core.cluster.children import run_in_children
from mbtf_core.cluster.task import Task
if __name__ == "__main__":
    list(run_in_children([Task("a", "{TASKS}:wait_long", {{"mark": sys.argv[1]}})]))
"""


def wait_until(met: Callable[[], bool]) -> None:
    for _ in range(600):
        if met():
            return
        time.sleep(0.05)
    raise AssertionError("waited in vain")


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_failures_end_their_task_alone() -> None:
    tasks = [Task(kind, f"{TASKS}:fail", {"kind": kind}) for kind in ("killed", "bug")]
    killed, bug, good = run_in_children([*tasks, Task("good", f"{TASKS}:double", {"x": 2})])
    assert killed.error == "its process ended with code -9"
    assert bug.error == "internal error: ZeroDivisionError: a bug"
    assert good.value == 4


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_child_ends_with_a_killed_command(tmp_path: Path, number: signal.Signals) -> None:
    script, mark = tmp_path / "command.py", tmp_path / "mark"
    script.write_text(COMMAND)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests")))}
    line = [sys.executable, str(script), str(mark)]
    command = subprocess.Popen(line, env=environment, stderr=subprocess.DEVNULL)
    wait_until(mark.exists)
    child = int(mark.read_text())
    assert is_running(child)
    command.send_signal(number)
    command.wait(30)
    wait_until(lambda: not is_running(child))
