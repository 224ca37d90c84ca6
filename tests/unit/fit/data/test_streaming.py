"""Training queries that stay on disk: the same batches, and memory that does not grow with the data."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from conftest import RunPython
from support.fit_data import parallax, write_data

import mbtf_fit.evaluation
from mbtf_core.data.dataset import Dataset
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition, load_training
from mbtf_fit.data.streaming import StreamedQueries
from mbtf_fit.evaluation import Predict
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.fit import fit

HELD_OUT = HeldOutSection(queries=0.1, radius=0.3)


def test_batches_are_those_of_data_in_memory(tmp_path: Path) -> None:
    data = Dataset.open(write_data(tmp_path / "d", parallax, train=9000, shards=3))
    memory = load_training(data, HELD_OUT, 0)
    disk = load_training(data, HELD_OUT, 0, memory=1.0)
    assert isinstance(disk.training, StreamedQueries)
    assert len(disk.training) == len(memory.training)
    batches = (islice(part.training.batches(1000, 0, 5), 16) for part in (memory, disk))
    for a, b in zip(*batches, strict=True):
        for name in ("u", "sigma", "omega_i", "omega_o", "value"):
            assert (getattr(a, name) == getattr(b, name)).all(), name


@pytest.mark.parametrize("suffix", [".npz", ".exr"])
def test_evaluation_streams_its_queries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    """Data that a fit streams can be evaluated too, on the queries that the fit held out."""
    folder = write_data(tmp_path / "d", parallax, train=3000, test=500, suffix=suffix)
    held_out = {"queries": 0.2, "radius": 0.3}
    config = FitConfig.model_validate(
        {"training": {"steps": 2, "batch": 500}, "held_out": held_out, "seed": 3}
    )
    result = fit(config, folder, tmp_path / "m")
    original, found = mbtf_fit.evaluation.evaluate_splits, []

    def watched(predict: Predict, data: Dataset, partition: Partition) -> dict[str, Any]:
        found.append(partition.training)
        return original(predict, data, partition)

    monkeypatch.setattr(mbtf_fit.evaluation, "evaluate_splits", watched)
    errors = mbtf_fit.evaluation.evaluate(result.material, folder)["errors"]
    assert isinstance(found[0], StreamedQueries)
    assert set(errors) == set(result.errors)
    for name, expected in result.errors.items():
        assert errors[name]["n"] == expected["n"]
        assert errors[name]["mse"]["value"] == pytest.approx(expected["mse"]["value"], rel=1e-3)


def test_exr_shards_too_large_for_memory_are_refused(tmp_path: Path) -> None:
    data = Dataset.open(write_data(tmp_path / "d", parallax, train=1000, suffix=".exr"))
    with pytest.raises(InputError, match=r"more than data\.memory allows.*\n.*--format npz"):
        load_training(data, HELD_OUT, 0, memory=1e4)


def test_memory_does_not_grow_with_the_data(tmp_path: Path, run_python: RunPython) -> None:
    """48 MB more of shards take less than 14 MB more at the peak; in memory they would take 38."""
    sizes = (2, 10)
    for n in sizes:
        write_data(tmp_path / str(n), parallax, train=100_000 * n, test=10, shards=n)
    code = (
        "import resource, sys\n"
        "from mbtf_fit.config import HeldOutSection\n"
        "from mbtf_fit.data.loader import load_training\n"
        "from mbtf_core.data.dataset import Dataset\n"
        f"for shards in {sizes}:\n"
        f"    data = Dataset.open({str(tmp_path)!r} + f'/{{shards}}')\n"
        "    part = load_training(data, HeldOutSection(), 0, memory=1e6)\n"
        "    for k, batch in enumerate(part.training.batches(10_000, 0, 0)):\n"
        "        if k == 10 * shards: break\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr
    small, large = (int(line) / 1024 for line in done.stdout.split())
    assert large - small < 14, (small, large)
