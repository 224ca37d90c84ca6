"""The exact words that answer people's mistakes (see tests/support/snapshots.py for how to change them)."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.mistakes import LINES, answer, call, write_files
from support.snapshots import check_snapshot


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("mistakes").resolve()
    write_files(made)
    return made


@pytest.mark.parametrize("group", LINES)
def test_wording(group: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    answers = [answer(line, folder) for line in LINES[group]]
    check_snapshot(group.replace(" ", "-"), "\n".join(answers))


@pytest.mark.parametrize("group", LINES)
def test_every_mistake_is_refused_in_two_lines(
    group: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    for line in LINES[group]:
        done = call(line)
        assert done.code in (2, 3), (line, done)
        errors = done.err[done.err.find("error: ") :].splitlines() if "error: " in done.err else []
        # `verify` reports what it found on standard output.
        assert len(errors) <= 2, (line, done)
        assert errors or done.out, (line, done)
        assert "Traceback" not in done.err
