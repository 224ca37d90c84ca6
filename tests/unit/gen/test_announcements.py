"""Long commands state their time and size before they start, and refuse what does not fit on the disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mbtf_core.app.console import run
from mbtf_core.data.shard_files import row_bytes
from mbtf_core.files import folders
from mbtf_gen import forecast
from mbtf_gen.cli.app import app
from mbtf_gen.generation import run as generation

DRAFT = 400 * 128**2 + 65536


@pytest.fixture
def heights(tmp_path: Path) -> Path:
    np.save(tmp_path / "height.npy", np.random.default_rng(0).random((256, 256)))
    return tmp_path / "height.npy"


@pytest.mark.parametrize(
    "words",
    [(), ("reference", "--size", "512"), ("preview", "--size", "1024")],
)
def test_what_does_not_fit_is_refused_before_anything_is_written(
    heights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e6))
    out = heights.parent / "out"
    line = [*words[:1], str(heights), *words[1:], "--height-scale", "0.01", "-o", str(out)]
    assert run(app, line) == 3
    message = capsys.readouterr().err
    assert "1.0 MB are free" in message
    assert "-o" in message.splitlines()[-1]
    assert not out.exists()


def stop(*_: Any, **__: Any) -> Any:
    raise KeyboardInterrupt


@pytest.mark.parametrize(("options", "queries"), [((), DRAFT), (("--resolution", "64"), 400 * 64**2 + 65536)])
def test_a_long_run_states_time_and_size(
    heights: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    queries: int,
) -> None:
    """Before the first shard, and, for a new data set, before its folder is made."""
    out = heights.parent / "out"
    seen: list[bool] = []

    def pilot(*_: Any, **__: Any) -> Any:
        seen.append(out.exists())
        return SimpleNamespace(start=5.0, seconds=600.0)

    monkeypatch.setattr(generation, "open_folder", lambda job, folder, plan, overwrite: stop(plan(job)))
    monkeypatch.setattr(forecast, "LONG_RUN", 1)
    monkeypatch.setattr(forecast, "forecast", pilot)
    plan = SimpleNamespace(effects=SimpleNamespace(closed_form=False))
    monkeypatch.setattr(generation, "plan_run", lambda *_: plan)
    words = [str(heights), "--height-scale", "0.01", "--quality", "draft", *options, "-o", str(out)]
    assert run(app, words) == 130
    size = f"{queries * row_bytes(holes=False) / 1e6:.0f} MB"
    err = capsys.readouterr().err
    assert f"resolution {options[1] if options else 128}, {size}" in err
    assert f"expected: about 10:05, {size} on disk; faster: --queries 100/texel" in err
    assert seen == [False]
