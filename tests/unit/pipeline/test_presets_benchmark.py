"""`benchmarks/quality.py`: stored runs are reused only while their preset is unchanged; the table."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from support.scripts import BENCHMARKS, benchmark_module


def test_runs_of_other_options_and_damaged_ones_are_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    quality = benchmark_module("quality")
    old = quality.MeasuredRun("rock", "high", 0.12, 800.0, 100.0, 600.0, 0.12, 0.003, 10**9, 10**6, "old")
    now = replace(old, options_hash=quality.options_hash("high"))
    texts = {"now": json.dumps(asdict(now)), "old": json.dumps(asdict(old)), "cut": '{"material": "ro'}
    for name, text in texts.items():
        (tmp_path / f"{name}-128.json").write_text(text)
    assert quality.finished(tmp_path / "now-128.json") == now
    assert all(quality.finished(tmp_path / f"{name}-128.json") is None for name in ("old", "cut", "none"))
    assert quality.finished_runs(tmp_path, 128) == [now]
