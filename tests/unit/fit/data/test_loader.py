"""Reading shards for training: what is held out, what is refused, what stays on disk."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import RunPython
from support.datasets import rewrite
from support.fit_data import constant, parallax, write_data

import mbtf_fit.evaluation
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import read_shard
from mbtf_core.errors import InputError
from mbtf_fit.config import FitConfig
from mbtf_fit.data.loader import Partition, in_region, load_split, load_training
from mbtf_fit.data.queries import ShardQueries, batch_starts
from mbtf_fit.data.streaming import StreamedQueries
from mbtf_fit.evaluation import Predict, split_errors
from mbtf_fit.sections import HeldOutSection
from mbtf_fit.training.fit import fit

HELD_OUT = HeldOutSection(queries=0.1, radius=0.3)


def partition(folder: Path, seed: int = 0, held_out: HeldOutSection = HELD_OUT) -> Partition:
    return load_training(Dataset.open(folder), held_out, seed)


def rows(*arrays: np.ndarray) -> set[bytes]:
    """Each query as bytes, to compare sets of them."""
    flat = np.concatenate([a.reshape(len(a), -1) for a in arrays], 1)
    return {row.tobytes() for row in flat}


def keys(part: ShardQueries) -> set[bytes]:
    return rows(part.u, part.sigma, part.omega_i)


def test_every_query_is_either_trained_on_or_held_out(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "d", parallax, train=3000)
    part = partition(folder)
    t = part.training
    trained = rows(t.u.numpy(), t.sigma.numpy(), t.omega_i.numpy())
    sets = [trained, keys(part.held_out_queries), keys(part.held_out_directions)]
    assert sum(map(len, sets)) == 3000
    assert set.union(*sets) == keys(load_split(Dataset.open(folder), "train"))
    assert 200 < len(sets[1]) < 400
    # Training errors are measured on training queries alone.
    assert keys(part.sample) == trained


@pytest.mark.parametrize(("total", "size"), [(10, 4), (9, 5), (8, 8), (7, 1)])
def test_every_query_is_used_in_some_epoch(total: int, size: int) -> None:
    """Where batches do not come out even, each epoch leaves out others."""
    starts = list(islice(batch_starts(total, size, 0, 0), 60 * (total // size)))
    assert {k for start in starts for k in range(start, start + size)} == set(range(total))


def test_queries_know_their_group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the errors of held-out queries, each group counts once."""
    data = Dataset.open(write_data(tmp_path / "d", parallax, train=4000))
    assert load_training(data, HELD_OUT, 0).held_out_queries.group is None
    monkeypatch.setattr(Dataset, "lights_per_path", lambda data, split: 4)
    found = load_training(data, HELD_OUT, 0)
    labels = [q.group for q in (found.held_out_queries, found.held_out_directions) if q.group is not None]
    # Whole groups are held out, of both shards.
    assert (np.unique(np.concatenate(labels), return_counts=True)[1] == 4).all()
    errors = split_errors(lambda queries: queries.value_a, found.held_out_queries, data)
    assert errors["n"] == len(labels[0])
    assert errors["mse"]["n"] == len(np.unique(labels[0])) < 0.5 * len(labels[0])


def test_shards_are_divided_independently(tmp_path: Path) -> None:
    """Rows of equal number share no fate."""
    folder = write_data(tmp_path / "d", parallax, train=2000)
    t = partition(folder, held_out=HeldOutSection(queries=0.3, radius=0)).selection
    kept = [{int(row) for _, some in t.pieces(*t.starts[k : k + 2]) for row in some} for k in (0, 1)]
    # Of rows that the one keeps the other keeps 70% too.
    assert 0.6 < len(kept[0] & kept[1]) / len(kept[0]) < 0.8


def test_held_out_directions_are_never_trained_on(tmp_path: Path) -> None:
    part = partition(write_data(tmp_path / "d", parallax, train=20_000))
    for omega in (part.training.omega_i.numpy(), part.training.omega_o.numpy()):
        assert not in_region(HELD_OUT, omega).any()
    out = part.held_out_directions
    assert (in_region(HELD_OUT, out.omega_i) | in_region(HELD_OUT, out.omega_o)).all()
    # A disk of radius 0.3 holds 9/99 of the directions, for light and for view.
    assert len(out) / 20_000 == pytest.approx(1 - (1 - 0.09 / 0.99) ** 2, abs=0.015)
    for omega in (part.held_out_queries.omega_i, part.held_out_queries.omega_o):
        assert not in_region(HELD_OUT, omega).any()


def test_the_division_is_reproducible_and_follows_the_seed(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "d", parallax, train=2000)
    first, again, other = (partition(folder, seed) for seed in (0, 0, 1))
    assert keys(first.held_out_queries) == keys(again.held_out_queries) != keys(other.held_out_queries)
    assert keys(first.held_out_directions) == keys(other.held_out_directions)


def test_values_are_the_mean_of_both_halves(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "d", constant(0.3), train=500, noise=0.1)
    everything = HeldOutSection(queries=0, radius=0)
    found = partition(folder, held_out=everything)
    data = load_split(Dataset.open(folder), "train")
    np.testing.assert_allclose(found.training.value.numpy(), (data.value_a + data.value_b) / 2, rtol=1e-6)
    np.testing.assert_array_equal(found.training.u.numpy(), data.u)
    assert len(found.held_out_queries) == len(found.held_out_directions) == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["value_b", "sigma"])
def test_a_shard_with_nan_or_infinity_is_refused_by_name(tmp_path: Path, bad: float, name: str) -> None:
    folder = write_data(tmp_path / "d", parallax, train=1000)
    path = folder / "train-00001.npz"
    array = read_shard(path, mapped=False)[name]
    array[7] = bad
    rewrite(path, **{name: array})
    with pytest.raises(InputError, match=rf"train-00001\.npz: '{name}' holds NaN or infinite .* row 7"):
        partition(folder)


def test_large_finite_values_are_no_fault(tmp_path: Path) -> None:
    part = partition(write_data(tmp_path / "d", constant(3e38), train=1000))
    assert np.isfinite(part.held_out_queries.value_a).all()


def test_nothing_to_train_on_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no queries"):
        partition(write_data(tmp_path / "none", parallax, train=0, shards=0))
    with pytest.raises(InputError, match="has no queries"):
        partition(write_data(tmp_path / "empty", parallax, train=0, shards=1))
    folder = write_data(tmp_path / "all", parallax, train=100)
    with pytest.raises(InputError, match="held out"):
        partition(folder, held_out=HeldOutSection(direction=(0, 0), radius=0.999, queries=0.4))
    with pytest.raises(InputError, match="test split has no queries"):
        load_split(Dataset.open(write_data(tmp_path / "t", parallax, train=9, test=0)), "test")


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
