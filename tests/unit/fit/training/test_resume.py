"""A fit that is killed at any step and started again ends as if nothing had been."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from support.fit_data import parallax, write_data
from support.killed_fits import Killed, run_killed
from support.known_surfaces import geometry, rough_heights
from support.slice_data import write_slices

import mbtf_fit.training.fit
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_core.files import folders
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import load_training
from mbtf_fit.training.fit import FitResult, fit
from mbtf_fit.training.fit_folder import read_history
from mbtf_fit.training.loop import TrainingLoop, read_checkpoint, state_tensors, write_checkpoint
from mbtf_fit.training.trainer import Trainer, prepare_trainer

STEPS = 10


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rough = geometry(Lattice(3), rough_heights(16, 16), roughness=0.4, metallic=0.7, seed=0)
    folder = tmp_path_factory.mktemp("data") / "shards"
    return write_data(folder, parallax, train=3000, test=300, noise=0.01, geometry=rough)


def config(memory: str = "1GB") -> FitConfig:
    training = {"steps": STEPS, "batch": 300, "warmup": 3}
    return FitConfig.model_validate({"training": training, "data": {"memory": memory}})


@pytest.fixture(scope="module")
def whole(shards: Path, tmp_path_factory: pytest.TempPathFactory) -> FitResult:
    """The fit that nothing stopped."""
    return fit(config(), shards, tmp_path_factory.mktemp("whole") / "m")


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look and save after every step."""
    monkeypatch.setattr(mbtf_fit.training.fit, "_REPORT_SECONDS", 0.0)
    monkeypatch.setattr(mbtf_fit.training.fit, "_CHECKPOINT_SECONDS", 0.0)


@pytest.mark.parametrize("memory", ["1GB", "1kB"])
def test_a_fit_killed_at_random_steps_ends_with_the_same_bits(
    shards: Path,
    whole: FitResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    often: None,
    memory: str,
) -> None:
    out = tmp_path / "killed"
    found, kills = run_killed(monkeypatch, lambda: fit(config(memory), shards, out))
    assert kills >= 2
    mine, other = found.material.model.weights(), whole.material.model.weights()
    assert all(torch.equal(mine[name], other[name]) for name in other)
    assert found.errors == whole.errors
    steps = [record["step"] for record in read_history(out)]
    assert steps == sorted(set(steps))
    assert steps[-1] == STEPS


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_fit_that_fails_at_once_leaves_no_folder(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, often: None, overwrite: bool
) -> None:
    held_out = {"direction": [0, 0], "radius": 0.999, "queries": 0.4}
    nothing = FitConfig.model_validate({"held_out": held_out})
    with pytest.raises(InputError, match="are held out"):
        fit(nothing, shards, tmp_path / "m", overwrite=overwrite)
    assert list(tmp_path.iterdir()) == []
    # Once there is a checkpoint, it is kept.
    monkeypatch.setattr(mbtf_fit.training.fit, "export_fits", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fit(config(), shards, tmp_path / "m", overwrite=overwrite)
    assert {"fit.json", "config.yaml", "checkpoint.safetensors"} <= {
        p.name for p in (tmp_path / "m").iterdir()
    }


@pytest.mark.parametrize("at", ["unlink", "write_json", "write_document"])
def test_a_fit_killed_while_it_replaces_another_is_repeated(
    shards: Path, whole: FitResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    unlink = Path.unlink

    def die(path: Path, *arguments: Any, **options: Any) -> None:
        if at != "unlink" or path.name == "weights.safetensors":
            raise Killed
        unlink(path, *arguments, **options)

    other = FitConfig.model_validate({"training": {"steps": 2, "batch": 300}, "seed": 1})
    shutil.copytree(whole.folder, tmp_path / "m")
    with monkeypatch.context() as patch:
        patch.setattr(Path if at == "unlink" else folders, at, die)
        with pytest.raises(Killed):
            fit(other, shards, tmp_path / "m", overwrite=True)
    assert not (tmp_path / "m" / "material.json").exists()
    assert not fit(other, shards, tmp_path / "m", overwrite=True).resumed


def test_ctrl_c_loses_no_step(shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also between checkpoints, and also with a budget of time."""
    import signal

    training = {"time": "1h", "batch": 300}
    budget = FitConfig.model_validate({"training": training})
    step, count = Trainer._step, 0

    def interrupted(self: Trainer, *arguments: Any) -> torch.Tensor:
        nonlocal count
        count += 1
        if count == 7:
            signal.raise_signal(signal.SIGINT)
        return step(self, *arguments)

    monkeypatch.setattr(Trainer, "_step", interrupted)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        fit(budget, shards, tmp_path / "m")
    assert signal.getsignal(signal.SIGINT) == before
    from mbtf_fit.material.format import read_tensors

    _, data = read_tensors(tmp_path / "m" / "checkpoint.safetensors")
    assert data["step"] == 7
    assert data["seconds"] > 0


@pytest.mark.parametrize(("model", "at", "steps"), [("neumip+", 65, 70), ("rainer2019", 5, 8)])
def test_a_checkpoint_holds_what_a_model_learns_beside_its_weights(
    model: str, at: int, steps: int, shards: Path, tmp_path: Path
) -> None:
    """Of learned heights at a step at which rays see newer ones than normals and horizons; of an encoder."""
    data = Dataset.open(write_slices(tmp_path / "data") if model == "rainer2019" else shards)
    training = {"steps": steps, "batch": 1024, "warmup": 3}
    options = FitConfig.model_validate({"model": model, "training": training})
    partition = load_training(data, options.held_out, 0)
    loops = [TrainingLoop([prepare_trainer(options, data, partition, torch.device("cpu"))]) for _ in range(3)]
    whole, first, second = loops
    for loop, step in ((whole, steps), (first, at), (second, steps)):
        if loop is second:
            write_checkpoint(first, tmp_path / "state")
            read_checkpoint(second, tmp_path / "state")
        while loop.trainers[0].progress.step < step:
            loop.train(0.0)
    expected, found = state_tensors(whole), state_tensors(second)
    assert all(torch.equal(found[name], tensor) for name, tensor in expected.items())
    weights = second.trainers[0].model.weights()
    # Normals that are filtered again are equal up to rounding.
    for name, tensor in whole.trainers[0].model.weights().items():
        torch.testing.assert_close(weights[name], tensor, rtol=0, atol=1e-8)
