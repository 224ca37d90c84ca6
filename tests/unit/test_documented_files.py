"""Files of the project that README and documentation name exist."""

from __future__ import annotations

import re

from support.paths import ROOT

PATH = re.compile(r"`(?:python )?((?:tests|benchmarks|pipelines|docs|mbtf_\w+)/[\w./*-]*|test_\w+\.py)[`: ]")


def test_every_file_that_pages_name_exists() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    named = {(page.name, name) for page in pages for name in PATH.findall(page.read_text())}
    assert named
    named -= {("README.md", "docs/_build/html/index.html")}  # made by `make docs`
    missing = [(page, name) for page, name in sorted(named) if not any(ROOT.glob(where(name)))]
    assert missing == []


def where(name: str) -> str:
    """Pattern of a path, or of a test's file name, which tables give without its folder."""
    return name if "/" in name else f"tests/**/{name}"
