"""Event files for TensorBoard hold the history of a fit."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.fit_data import parallax, write_data

from mbtf_fit.config import FitConfig
from mbtf_fit.training.fit import fit
from mbtf_fit.training.fit_folder import EventLog, read_history


def test_event_files_hold_the_history(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="no TensorBoard; to enable: pip install 'mbtf[tensorboard]'")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    shards = write_data(tmp_path / "shards", parallax)
    config = FitConfig.model_validate({"model": "neumip-baseline", "training": {"steps": 20, "batch": 64}})
    with EventLog(tmp_path / "curves") as log:
        fit(config, shards, tmp_path / "material", observe=log)
    events = EventAccumulator(str(tmp_path / "curves"))
    events.Reload()
    history = read_history(tmp_path / "material")
    assert history
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    assert losses == [(record["step"], pytest.approx(record["loss"])) for record in history]
    errors = [event.value for event in events.Scalars("unexplained variance")]
    finite = [record["unexplained"] for record in history if record["unexplained"] is not None]
    assert errors == pytest.approx(finite)
    levels = [tag for tag in events.Tags()["scalars"] if tag.startswith("unexplained variance by level/")]
    assert len(levels) > 1
