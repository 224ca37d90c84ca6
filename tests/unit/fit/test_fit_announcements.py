"""A long fit states its time and size before it starts, and is refused where it does not fit on the disk."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.fit_data import parallax, write_data

from mbtf_core.app.console import run
from mbtf_core.files import folders
from mbtf_fit.cli.app import app
from mbtf_fit.training import fit as fits


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data") / "shards", parallax, train=6000, noise=0.01)


def stop(*_: Any, **__: Any) -> Any:
    raise KeyboardInterrupt


def test_a_long_fit_states_time_and_size(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fits, "fit", stop)
    out = tmp_path / "material"
    assert run(app, [str(shards), "--time", "2min", "-o", str(out)]) == 130
    # Loading and evaluation are included.
    assert "expected: about 2:05, " in capsys.readouterr().err
    assert run(app, [str(shards), "--time", "20s", "-o", str(out)]) == 130
    assert "expected" not in capsys.readouterr().err
    monkeypatch.setattr(folders.shutil, "disk_usage", lambda path: SimpleNamespace(free=1e4))
    assert run(app, [str(shards), "-o", str(out)]) == 3
    assert "10 kB are free" in capsys.readouterr().err
    assert not out.exists()
