"""Text of others inside Markdown: shown as it is, never read as markup."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence

# What Markdown gives a meaning inside a line: markup, cells, formulas, and addresses that become links.
_MARKUP = re.compile(r"[\\`*_\[\]|~$@]|:(?=//)|(?<=www)\.", re.IGNORECASE)


def escaped(text: str) -> str:
    """A text inside a line of Markdown, with markup, HTML and addresses made harmless."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return html.escape(_MARKUP.sub(r"\\\g<0>", plain), quote=False)


def code(text: str) -> str:
    """A text as inline code, in as many backticks as it needs."""
    plain = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    fence = "`" * (1 + max((len(run) for run in re.findall(r"`+", plain)), default=0))
    padded = f" {plain} " if plain[:1] == "`" or plain[-1:] == "`" else plain
    # A bar would end the cell of a table, even inside code.
    return f"{fence}{padded}{fence}".replace("|", "\\|") if plain else ""


def fenced(text: str, language: str = "") -> str:
    """A text as a block of code, with a fence that it does not contain."""
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall(r"`+", text)), default=0))
    return f"{fence}{language}\n{text}\n{fence}"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of cells that are Markdown already."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
