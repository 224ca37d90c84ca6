"""Tables of options and stored arrays in the pages are those of the programs."""

from __future__ import annotations

import importlib
from types import ModuleType

import pytest
from support.paths import ROOT

SCRIPT = "docs/extensions/write_tables.py"


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str((ROOT / SCRIPT).parent))
    return importlib.import_module("write_tables")


@pytest.mark.parametrize("name", ["configuration", "data-format"])
def test_tables_are_up_to_date(tables: ModuleType, name: str) -> None:
    path = ROOT / "docs" / "reference" / f"{name}.md"
    assert path in tables.PAGES
    page = path.read_text(encoding="utf-8")
    assert tables.written(page) == page, f"run: python {SCRIPT}"


def test_a_table_that_was_edited_is_found(tables: ModuleType) -> None:
    pages = [path.read_text(encoding="utf-8") for path in tables.PAGES]
    for page, row in zip(pages, ("| `training.huber_delta` |", "| `omega_i` |"), strict=True):
        assert page.count(row) == 1
        assert tables.written(page.replace(row, "| `edited` |")) == page


def test_cells_show_text_as_it_is(tables: ModuleType) -> None:
    from configuration_reference import cell

    assert (
        cell("a < b | ``c | d`` *e* [f] g_h _i $j") == "a \\< b \\| `c \\| d` \\*e\\* \\[f\\] g_h \\_i \\$j"
    )
