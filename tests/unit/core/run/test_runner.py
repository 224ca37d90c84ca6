"""What all runners promise, and processes and threads of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support import run_tasks
from support.paths import ROOT

from mbtf_core.errors import InputError
from mbtf_core.run.cluster import open_runner
from mbtf_core.run.processes import Processes, run_child
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item

COMMAND = """
import sys
from support.run_tasks import wait_long
from mbtf_core.run.processes import Processes
from mbtf_core.run.task import Item
list(Processes().map(wait_long, [Item("a", {"mark": sys.argv[1]})]))
"""


@pytest.fixture(scope="module", params=["here", "processes", "workers"])
def runner(request: pytest.FixtureRequest) -> Iterator[Runner]:
    if request.param == "workers":
        pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")
        with open_runner("local:2", lambda line: None) as opened:
            yield opened
    else:
        yield Processes(2) if request.param == "processes" else Runner()


def test_every_item_has_its_result(runner: Runner) -> None:
    items = (Item(f"double-{x}", {"x": x}) for x in range(5))
    found = {done.name: done.value for done in runner.map(run_tasks.double, items)}
    assert found == {f"double-{x}": 2 * x for x in range(5)}


def test_a_failure_is_named_with_its_hint_and_leaves_the_others(runner: Runner) -> None:
    kinds = ("partial", "none")
    found = {d.name: d for d in runner.map(run_tasks.fail, [Item(kind, {"kind": kind}) for kind in kinds])}
    assert (found["partial"].error, found["partial"].hint) == ("the disk is full", "make room")
    assert not found["none"].error


def test_bad_input_ends_the_run_unless_the_items_are_independent(runner: Runner) -> None:
    items = [Item("bad", {"kind": "input"})]
    with pytest.raises(InputError, match=r"map.png: is not there"):
        list(runner.map(run_tasks.fail, items))
    (done,) = runner.map(run_tasks.fail, items, independent=True)
    assert done.error == "map.png: is not there"


def test_a_task_in_parts_has_its_value(runner: Runner, tmp_path: Path) -> None:
    items = [Item(str(x), {"x": x, "folder": str(tmp_path)}) for x in range(5)]
    found = {done.name: done.value or done.error for done in runner.map(run_tasks.in_parts, items)}
    assert found == {"0": "", "1": -1, "2": 2, "3": "the disk is full", "4": 4}
    assert len(list(tmp_path.glob("closed-*"))) == 4


def test_first_and_last_parts_run_beside_the_others(tmp_path: Path) -> None:
    items = [Item(str(x), {"x": x, "folder": str(tmp_path)}) for x in (0, 2, 5, 6, 7)]
    with pytest.raises(KeyboardInterrupt):
        list(Runner().map(run_tasks.in_parts, items))
    threads = {path.name: path.read_text().partition("_")[0] for path in tmp_path.iterdir()}
    assert threads["first-2"] == "ahead"
    assert threads["second-2"] == "MainThread"
    # What was rendered before the interruption is stored, and everything that was begun is closed.
    assert threads["third-0"] == threads["third-2"] == "behind"
    begun = {name.partition("-")[2] for name in threads if name.startswith("first")}
    assert begun == {name.partition("-")[2] for name in threads if name.startswith("closed")}
    assert "7" not in begun


def test_locked_items_are_tried_again_after_the_others(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    items = [Item(name, {"marks": str(tmp_path / name), "times": n}) for name, n in (("a", 1), ("b", 0))]
    found = [(done.name, done.value) for done in Runner().map(run_tasks.locked_at_first, items)]
    assert found == [("b", 1), ("a", 2)]
    for_ever = Item("a", {"marks": str(tmp_path / "a"), "times": 100})
    (done,) = Runner().map(run_tasks.locked_at_first, [for_ever])
    assert done.locked


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


def test_a_crash_ends_its_process_alone() -> None:
    items = [Item(kind, {"kind": kind}) for kind in ("killed", "bug", "none")]
    killed, bug, good = Processes().map(run_tasks.fail, items)
    assert killed.error == "the process was ended by SIGKILL"
    assert bug.error == "internal error: ZeroDivisionError: a bug"
    assert not good.error


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
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


@pytest.mark.parametrize(
    ("function", "arguments", "answers", "fault"),
    [
        ("answer", ["a b"], {"step": 2, "text": "a b"}, ""),
        ("abort", [], {"step": 1}, "the process was ended by SIGABRT (LLVM ERROR: Cannot select)"),
        ("fail", [], {"step": 1}, r"is\nbroken"),
        ("leave", [], {"step": 1}, "the process was ended with exit code 7"),
        ("hang", [], {"step": 1}, "no answer within 4 s"),
    ],
)
def test_the_end_of_a_child_is_reported(
    function: str, arguments: list[str], answers: dict[str, object], fault: str
) -> None:
    outcome = run_child("support.children", function, *arguments, timeout=4 if function == "hang" else 60)
    assert (outcome.answers, outcome.fault) == (answers, fault)
