"""Text of others in Markdown: a reader of CommonMark and tables shows it as it is."""

from __future__ import annotations

import html
import re

import pytest
from markdown_it import MarkdownIt

from mbtf_gen.publishing.card import code, escaped, fenced

HOSTILE = [
    "<script>alert(1)</script>",
    "![x](https://example.org/pixel.png)",
    "[x](javascript:alert(1))",
    "a | b",
    "**bold** _it_ ~~no~~ `code`",
    "&lt;b&gt; &amp;",
    "<https://example.org>",
    "back\\slash \\*",
    "<!-- hidden",
    "``` `` `",
    "`start and end`",
    "$x_1$ @name",
]


def shown(markdown: str) -> tuple[str, set[str]]:
    """Text that a reader of a page sees, and the tags of the page."""
    page = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).render(markdown)
    return html.unescape(re.sub(r"<[^>]*>", "", page)).strip(), set(re.findall(r"</?(\w+|!--)", page))


@pytest.mark.parametrize("text", HOSTILE)
def test_text_is_shown_as_it_is(text: str) -> None:
    assert shown(f"Name: {escaped(text)}") == (f"Name: {text}", {"p"})


@pytest.mark.parametrize("text", HOSTILE)
def test_code_is_shown_as_it_is(text: str) -> None:
    if "|" not in text:
        assert shown(f"Name: {code(text)}") == (f"Name: {text}", {"p", "code"})


@pytest.mark.parametrize("text", HOSTILE)
def test_cells_stay_cells(text: str) -> None:
    page = f"| a | b |\n| --- | --- |\n| {escaped(text)} | 1 |\n| {code(text)} | 2 |\n"
    found, tags = shown(page)
    assert tags == {"table", "thead", "tbody", "tr", "th", "td", "code"}
    assert found.split("\n")[-1].strip() == "2" or found.endswith("2")
    assert found.count(text) == 2


@pytest.mark.parametrize("text", [*HOSTILE, "```\n# heading\n```", "~~~\n````\nx"])
def test_blocks_end_where_they_should(text: str) -> None:
    found, tags = shown(fenced(text) + "\n\nafter")
    assert tags == {"pre", "code", "p"}
    assert found == f"{text.strip()}\n\nafter" or found.split() == f"{text} after".split()


def test_line_breaks_and_controls_become_blanks() -> None:
    assert escaped("a\n# b\x1b[2J\u202ec") == "a # b \\[2J c"
