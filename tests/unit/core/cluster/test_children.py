"""Tasks in processes of this machine, one after the other."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

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
    tasks = [Task("bad", f"{TASKS}:fail", {"kind": "killed"}), Task("good", f"{TASKS}:double", {"x": 2})]
    bad, good = run_in_children(tasks)
    assert bad.error == "its process ended with code -9"
    assert good.value == 4


def test_a_child_ends_with_a_killed_command(tmp_path: Path) -> None:
    script, mark = tmp_path / "command.py", tmp_path / "mark"
    script.write_text(COMMAND)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests")))}
    command = subprocess.Popen([sys.executable, str(script), str(mark)], env=environment)
    wait_until(mark.exists)
    child = int(mark.read_text())
    assert is_running(child)
    command.kill()
    command.wait()
    wait_until(lambda: not is_running(child))
