"""Command lines that the project shows: in pages, in the makefile, and in its own texts."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from .paths import ROOT

PACKAGES = ("mbtf_core", "mbtf_gen", "mbtf_fit", "mbtf_pipeline")
_PROGRAM = r"mbtf-(?:gen|fit|pipeline)"
# A command at the start of a line, after a prompt, a path to the programs, variables or another command.
_START = rf"(?:^|(?<=[;|&] )|(?<=\$ )|(?<=/))(?={_PROGRAM}\b)"
_FENCED = re.compile(r"^( *)```[^\n]*\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
# In sentences a command ends with the clause.
_CLAUSE = re.compile(r"[;,:)`\n]|\.(?:\s|$)|\s-- |''")


@dataclass(frozen=True)
class Shown:
    """A command line, where it stands, and whether it is a whole one rather than words of a sentence."""

    where: str
    text: str
    whole: bool = True


def shown_commands() -> list[Shown]:
    """Every command line of README, documentation, makefile, docstrings and messages."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = [shown for page in pages if page.exists() for shown in in_markdown(page.read_text(), _name(page))]
    found += _in_lines((ROOT / "Makefile").read_text().replace("$(BIN)/", ""), "Makefile")
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            found += in_strings(path.read_text(), _name(path))
    return found


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def code_block(page: str, language: str, number: int = 0) -> str:
    """A block of a language in a page, whose path is relative to the documentation."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return str(re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)[number])


def in_blocks(text: str, where: str) -> Iterator[Shown]:
    """Commands in fenced blocks: those that a reader runs."""
    for block in _FENCED.finditer(text):
        yield from _in_lines(block[2], where)


def in_markdown(text: str, where: str) -> Iterator[Shown]:
    """Commands in fenced and indented blocks, and in inline code."""
    yield from in_blocks(text, where)
    prose = _FENCED.sub("", text)
    yield from _in_lines("\n".join(re.findall(r"^(?: {4,}|\t)(.*(?:\\\n.*)*)", prose, re.MULTILINE)), where)
    for code in re.findall(r"`([^`]+)`", prose):
        if re.match(rf"{_PROGRAM}\b", code.strip()):
            yield Shown(where, " ".join(code.split()))


def _in_lines(text: str, where: str) -> Iterator[Shown]:
    for line in text.replace("\\\n", " ").splitlines():
        for start in re.finditer(_START, line.strip()):
            command = re.split(r"\s#|\s(?:&&|\|\||[|;>])\s|;\s", line.strip()[start.end() :])[0]
            yield Shown(where, command.strip())


def in_strings(source: str, where: str) -> Iterator[Shown]:
    """Commands in the string literals of a module; what is put into them stands as X."""
    if "mbtf-" not in source:
        return
    nodes = list(ast.walk(ast.parse(source)))
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            text = "".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in parts:
            text = node.value
        else:
            continue
        for start in re.finditer(rf"{_PROGRAM} (?=\S)", text):
            before, after = text[: start.start()], text[start.start() :]
            whole = not before or before.endswith((": ", "\n    "))
            words = re.split(r"\n|; |, | \(", after)[0] if whole else _CLAUSE.split(after)[0]
            yield Shown(where, words.strip(), whole)
