"""What the pages name exists: files, equations, tables of options, recipes."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from support.paths import ROOT

from mbtf_pipeline.collection.recipes import load
from mbtf_pipeline.recipe import Recipe

DOCS = ROOT / "docs"
PATH = re.compile(r"`(?:python )?((?:tests|benchmarks|pipelines|docs|mbtf_\w+)/[\w./*-]*|test_\w+\.py)[`: ]")


def test_every_file_that_pages_name_exists() -> None:
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]
    named = {(page.name, name) for page in pages for name in PATH.findall(page.read_text())}
    assert named
    named -= {("README.md", "docs/_build/html/index.html")}  # made by `make docs`
    # Tables give a test's file name without its folder.
    where = {name: name if "/" in name else f"tests/**/{name}" for _, name in named}
    assert [(page, name) for page, name in sorted(named) if not any(ROOT.glob(where[name]))] == []


def test_tables_are_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of options, stored arrays and operations."""
    monkeypatch.syspath_prepend(str(DOCS / "extensions"))
    tables = importlib.import_module("write_tables")
    assert [path.stem for path in tables.PAGES] == ["configuration", "data-format", "add-a-model"]
    for path in tables.PAGES:
        page = path.read_text(encoding="utf-8")
        assert tables.written(page) == page, "run: python docs/extensions/write_tables.py"


def test_the_recipe_of_the_page_is_valid(tmp_path: Path) -> None:
    text = (DOCS / "how-to/run-recipes.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    (tmp_path / "assets").symlink_to(ROOT / "assets")
    (tmp_path / "pipelines").mkdir()
    path = tmp_path / "pipelines" / "shown.yaml"
    path.write_text(shown, encoding="utf-8")
    assert isinstance(load(path), Recipe)
