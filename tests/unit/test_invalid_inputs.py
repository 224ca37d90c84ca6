"""The three programs refuse invalid input in one or two lines, with an exit code."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.invalid_inputs import LINES, call, write_files


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("inputs").resolve()
    write_files(made)
    return made


@pytest.mark.parametrize("group", LINES)
def test_invalid_input_is_refused_in_two_lines(
    group: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    for line in LINES[group]:
        done = call(line.split())
        assert done.code in (2, 3), (line, done)
        errors = done.err[done.err.find("error: ") :].splitlines() if "error: " in done.err else []
        # `verify` reports faults on standard output.
        assert len(errors) <= 2, (line, done)
        assert errors or done.out, (line, done)
        assert "Traceback" not in done.err


@pytest.mark.parametrize(
    "line",
    [
        ["heights.npy", "--mesh", "\x1b[31m"],
        ["heights.npy", "--mesh", "9" * 5000],
        ["heights.npy", "--make-tileable", "\0"],
        ["heights.npy", "--set", "\x1b[2J=1"],
        ["heights.npy", "two\x1b[31mwords"],
        ["\x1b]0;title\x07.npy"],
        ["two\nlines.npy"],
        ["x" * 5000],
    ],
)
def test_control_characters_are_escaped(
    line: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    done = call(["mbtf-gen", *line])
    assert done.code in (2, 3)
    lines = done.err[done.err.index("error: ") :].splitlines()
    assert len(lines) <= 2
    assert all(text.isprintable() and len(text) < 600 for text in lines), done.err
    assert "two\\nlines" in done.err or "\n" not in "".join(line), done.err
