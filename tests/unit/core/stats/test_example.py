"""``examples/dataset_statistics.py`` runs, and finds what the data were made with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support.datasets import write_dataset
from support.paths import ROOT

from mbtf_core import stats

EXAMPLE = (ROOT / "examples/dataset_statistics.py").read_text(encoding="utf-8")


def test_the_worked_example(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_dataset(tmp_path / "shards", queries={"train": "2000", "test": "4000"})
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(EXAMPLE, found)
    assert abs(stats.unexplained_variance(found["constant"], found["a"], found["b"]).value - 1.0) < 0.1
    assert found["better"].p_value < 1e-6
    # Two digits: the noise that the data were made with.
    assert "noise of one query: 0.03" in capsys.readouterr().out
