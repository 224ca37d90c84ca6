"""How a child process ends reaches its parent, and none outlives it."""

from __future__ import annotations

import subprocess

import pytest

from mbtf_core.run.processes import run_child


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


def test_an_interrupted_parent_leaves_no_child(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[str]] = []

    class Interrupted(subprocess.Popen):  # type: ignore[type-arg]
        @property
        def stdin(self):  # type: ignore[no-untyped-def]
            started.append(self)
            raise KeyboardInterrupt

        @stdin.setter
        def stdin(self, pipe):  # type: ignore[no-untyped-def]
            self.pipe = pipe

    monkeypatch.setattr("mbtf_core.run.processes.subprocess.Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_child("support.children", "hang", timeout=60)
    assert started[0].poll() is not None
