"""Messages that users can meet, collected from the sources, and those that docs/troubleshooting.md lists.

``python tests/support/messages.py`` prints what the document lacks, in its own format, and what it lists in
vain. A message is written as a pattern: ``…`` stands for whatever the program fills in.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "troubleshooting.md"
PACKAGES = ("mbtf_gen", "mbtf_fit", "mbtf_pipeline")
GAP = "…"

# Exceptions that are no message to a user: of Python's own protocols, and of what cannot happen.
_SILENT = {"AttributeError", "AssertionError", "KeyError"}
_ERRORS = {"UsageError", "InputError", "EngineError", "PartialError", "Interrupted"}
# Functions whose results become messages: module.function → position in a returned tuple, None for the whole.
_SAYERS = {
    "mbtf_gen.settings._explain": 1,
    "mbtf_gen.wording.explain": None,
    "mbtf_gen.verification._record_of": None,
    "mbtf_gen.verification._content_fault": None,
    "mbtf_gen.verification.examine": 1,
    "mbtf_gen.shard_making.busy_message": None,
    "mbtf_gen.console._usage_message": None,
}
# What a helper's results are followed into.
_TEXTS = (ast.Constant, ast.JoinedStr, ast.IfExp)
# Calls whose argument is a message: name → its position.
_CALLS = {"Fault": 1, "_fail": 0}


@dataclass(frozen=True, order=True)
class Message:
    """A message's pattern and where it is made."""

    pattern: str
    kind: str
    file: str
    function: str
    line: int


@cache
def collect() -> list[Message]:
    """All messages of the three packages, those that are a gap and nothing else left out."""
    return [m for m in _all() if _says_something(m.pattern)]


def relays() -> set[str]:
    """Functions (file and name) that pass on what another one said: a gap and nothing else."""
    return {f"{m.file}:{m.function}" for m in _all() if not _says_something(m.pattern)}


def _says_something(pattern: str) -> bool:
    return bool(pattern.strip(f"{GAP} .,:;()'"))


@cache
def _all() -> list[Message]:
    found: set[Message] = set()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            file = path.relative_to(ROOT).as_posix()
            found.update(Source(path.read_text(encoding="utf-8"), file).messages())
    return sorted(found)


class Source:
    """One source file: its text, and its path from the repository's root."""

    def __init__(self, text: str, file: str) -> None:
        self.file = file
        self.name = file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
        self.tree = ast.parse(text)
        self.functions = {
            n.name: n for n in ast.walk(self.tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)
        }
        self.owner: dict[ast.AST, ast.AST] = {}
        self._own(self.tree, self.tree)

    def _own(self, node: ast.AST, owner: ast.AST) -> None:
        """Note the function that each node lies in."""
        for child in ast.iter_child_nodes(node):
            self.owner[child] = owner
            self._own(child, child if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) else owner)

    def messages(self) -> Iterator[Message]:
        for node in ast.walk(self.tree):
            for kind, expression in self._expressions(node):
                for text in self.patterns(expression, self.owner.get(node, self.tree)):
                    function = getattr(self.owner.get(node, self.tree), "name", "")
                    yield Message(text.partition("\n")[0], kind, self.file, function, expression.lineno)

    def _expressions(self, node: ast.AST) -> Iterator[tuple[str, ast.expr]]:
        """(kind, expression) of every message that this node makes."""
        if isinstance(node, ast.Call) and node.args:
            name = _last_name(node.func)
            if name in _ERRORS:
                yield "error", node.args[0]
            elif name in _CALLS and len(node.args) > _CALLS[name] and isinstance(node.func, ast.Name):
                yield "error", node.args[_CALLS[name]]
            elif (name == "append" and "warning" in _path(node.func)) or name == "warning":
                yield "warning", node.args[0]
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            name = _last_name(node.exc.func)
            if name not in _ERRORS | _SILENT:
                yield "error", node.exc.args[0]
        elif isinstance(node, ast.AugAssign) and "warning" in _path(node.target):
            if isinstance(node.value, ast.List | ast.Tuple):
                yield from (("warning", element) for element in node.value.elts)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name, owner = node.targets[0].id, getattr(self.owner.get(node), "name", "")
            if name == "warning" or (name == "text" and f"{self.name}.{owner}" in _SAYERS):
                yield "warning" if name == "warning" else "error", node.value
        elif isinstance(node, ast.Return | ast.Yield) and node.value is not None:
            owner = self.owner.get(node)
            if isinstance(owner, ast.FunctionDef):
                yield from self._said(owner, node.value)
        elif isinstance(node, ast.FunctionDef) and f"{self.name}.{node.name}" in _SAYERS:
            # Texts that such a function chooses from tables of its module.
            used = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
            for table in (t for t in self.tree.body if isinstance(t, ast.Assign)):
                if isinstance(table.value, ast.Dict) and _last_name(table.targets[0]) in used:
                    yield from (("error", value) for value in table.value.values)

    def _said(self, function: ast.FunctionDef, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
        """What a function returns, where that is a message."""
        full = f"{self.name}.{function.name}"
        if full in _SAYERS:
            position = _SAYERS[full]
            if position is None:
                yield "error", value
            elif isinstance(value, ast.Tuple):
                yield "error", value.elts[position]
        elif function.name.endswith(("_warning", "_remark")):
            yield "warning", value

    def patterns(self, node: ast.expr, scope: ast.AST, depth: int = 0) -> set[str]:
        """What an expression of text may be, with gaps for what is not known."""
        if depth > 6:
            return {GAP}
        if isinstance(node, ast.Constant):
            return {node.value} if isinstance(node.value, str) else {GAP}
        if isinstance(node, ast.JoinedStr):
            return _joined([self.patterns(v, scope, depth + 1) for v in node.values])
        if isinstance(node, ast.FormattedValue):
            return {GAP}
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            return _joined([self.patterns(side, scope, depth + 1) for side in (node.left, node.right)])
        if isinstance(node, ast.IfExp):
            return self.patterns(node.body, scope, depth + 1) | self.patterns(node.orelse, scope, depth + 1)
        if isinstance(node, ast.BoolOp):
            return set().union(*(self.patterns(v, scope, depth + 1) for v in node.values))
        if isinstance(node, ast.Name):
            return self._assigned(node.id, scope, depth)
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
            return self._assigned(node.value.id, scope, depth)
        if isinstance(node, ast.Tuple):
            return set().union(*(self.patterns(v, scope, depth + 1) for v in node.elts))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in self.functions:
            function = self.functions[node.func.id]
            returns = [n.value for n in ast.walk(function) if isinstance(n, ast.Return) and n.value]
            if returns and all(isinstance(r, _TEXTS) for r in returns):
                return set().union(*(self.patterns(r, function, depth + 1) for r in returns))
        return {GAP}

    def _assigned(self, name: str, scope: ast.AST, depth: int) -> set[str]:
        """What a name may hold: what its function, else its module, assigns to it."""
        for place in (scope, self.tree):
            values = [
                n.value
                for n in ast.walk(place)
                if isinstance(n, ast.Assign)
                and any(isinstance(t, ast.Name) and t.id == name for t in n.targets)
                and (place is scope or self.owner.get(n) is self.tree)
            ]
            if values:
                return set().union(*(self.patterns(v, scope, depth + 1) for v in values))
        return {GAP}


def _joined(parts: list[set[str]]) -> set[str]:
    """Every way to put alternatives one after the other, neighbouring gaps made one."""
    texts = {"".join(choice) for choice in product(*parts)}
    return {re.sub(f"{GAP}+", GAP, text) for text in texts}


def _last_name(node: ast.AST) -> str:
    return getattr(node, "attr", getattr(node, "id", ""))


def _path(node: ast.AST) -> str:
    """``a.b.c`` of a dotted name."""
    return f"{_path(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def listed(text: str | None = None) -> list[str]:
    """Patterns that the document lists, in order: list items that are nothing but code."""
    if text is None:
        text = DOCUMENT.read_text(encoding="utf-8")
    return [m[2] for m in re.finditer(r"^- (`+) ?(.+?) ?\1$", text, re.MULTILINE)]


def item(pattern: str) -> str:
    """A pattern as the document lists it."""
    mark = "``" if "`" in pattern else "`"
    space = " " if "`" in pattern else ""
    return f"- {mark}{space}{pattern}{space}{mark}"


def main() -> int:
    """Print what is missing and what is stale; 1 where there is either."""
    said = set(listed() if DOCUMENT.exists() else [])
    made = {m.pattern: m for m in sorted(collect(), key=lambda m: (m.file, m.line), reverse=True)}
    missing = sorted((m for p, m in made.items() if p not in said), key=lambda m: (m.file, m.line))
    stale = sorted(said - set(made))
    for message in missing:
        print(f"{item(message.pattern)}    <!-- {message.kind}, {message.file}:{message.line} -->")
    for pattern in stale:
        print(f"not made any more: {pattern}")
    print(f"{len(made)} messages, {len(missing)} missing, {len(stale)} stale", file=sys.stderr)
    return 1 if missing or stale else 0


if __name__ == "__main__":
    sys.exit(main())
