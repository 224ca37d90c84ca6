"""Tables of options, stored arrays and operations in the pages are those of the programs."""

from __future__ import annotations

import importlib

import pytest
from support.paths import ROOT

SCRIPT = "docs/extensions/write_tables.py"


def test_tables_are_up_to_date(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str((ROOT / SCRIPT).parent))
    tables = importlib.import_module("write_tables")
    assert [path.stem for path in tables.PAGES] == ["configuration", "data-format", "add-a-model"]
    for path in tables.PAGES:
        page = path.read_text(encoding="utf-8")
        assert tables.written(page) == page, f"run: python {SCRIPT}"
