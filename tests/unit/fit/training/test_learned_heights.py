"""Fits of the model that learns heights: data without a geometry, resumed fits, a known depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from support.fit_data import parallax, write_data

from mbtf_fit import FitConfig, fit
from mbtf_fit.data.loader import load_training, open_data
from mbtf_fit.training.loop import TrainingLoop, read_checkpoint, write_checkpoint
from mbtf_fit.training.trainer import Trainer, prepare_trainer


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "shards"
    return write_data(folder, parallax, train=3000, test=500, aspect=0.75, noise=0.01)


def config(steps: int, **options: Any) -> FitConfig:
    training = {"steps": steps, "batch": 300, "warmup": 3, **options.pop("training", {})}
    return FitConfig.model_validate({"model": "neumip+", "training": training, **options})


def trainer_of(shards: Path, steps: int) -> Trainer:
    options = config(steps)
    data = open_data(shards, "shuffled", options.model)
    partition = load_training(data, options.held_out, options.seed)
    return prepare_trainer(options, data, partition, torch.device("cpu"))


def train_to(trainer: Trainer, step: int) -> None:
    """Train step by step, which ends where it is asked to."""
    while trainer.progress.step < step:
        TrainingLoop([trainer]).train(0.0)


def test_a_resumed_fit_is_the_same(shards: Path, tmp_path: Path) -> None:
    """At a step at which rays see newer heights than normals and horizons do."""
    whole, first, second = (trainer_of(shards, 70) for _ in range(3))
    train_to(whole, 70)
    train_to(first, 57)
    write_checkpoint(TrainingLoop([first]), tmp_path / "checkpoint")
    read_checkpoint(TrainingLoop([second]), tmp_path / "checkpoint")
    train_to(second, 70)
    wanted = whole.model.weights()
    for name, tensor in second.model.weights().items():
        assert torch.equal(tensor, wanted[name]), name


def test_a_depth_is_learned(tmp_path: Path) -> None:
    """A wave at a depth of 0.05, from values alone."""
    shards = write_data(tmp_path / "data", parallax, train=20_000, test=1000, finest=4)
    result = fit(config(300, training={"batch": 2000}), shards, tmp_path / "m")
    assert result.errors["test"]["unexplained"]["value"] < 0.02
    model = result.material.model
    depth = -model.known.heights * model.depth_weights[-1].detach()
    assert float(depth.mean()) == pytest.approx(0.05, abs=0.01)
