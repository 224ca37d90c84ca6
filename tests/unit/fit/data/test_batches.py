"""Batches for training code of one's own: each query once an epoch, in an order that the seed decides."""

from __future__ import annotations

import warnings
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np
import pytest
import torch
from support.datasets import edit, read_checksummed, rewrite, write_sidecar
from support.fit_data import constant, parallax, write_data, write_images
from support.slice_data import write_slices
from torch.utils.data import DataLoader

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import write_shard
from mbtf_core.errors import InputError
from mbtf_fit import QueryDataset
from mbtf_fit.data import batches
from mbtf_fit.data.queries import NEEDED, needed

ALBEDO, NOISE = 0.5, 0.1


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flat Lambert plane."""
    folder = tmp_path_factory.mktemp("batches") / "shards"
    return write_data(folder, constant(ALBEDO / np.pi), train=9001, test=100, noise=NOISE, shards=3)


def rows(data: QueryDataset, workers: int = 0) -> np.ndarray:
    """All numbers of an epoch (n, 16), query by query."""
    loader = DataLoader(data, batch_size=None, num_workers=workers)
    return np.concatenate([torch.cat([x.view(len(x), -1) for x in batch], 1).numpy() for batch in loader])


def stored(folder: Path, split: str = "train") -> np.ndarray:
    data = Dataset.open(folder)
    weight = ("weight",) if split == "test" and data.weighted else ()
    arrays = data.load(split, (*needed(data.estimates), *weight))
    arrays.setdefault("value_b", arrays["value_a"])
    arrays.setdefault("weight", np.ones_like(arrays["sigma"]))
    lead = arrays["sigma"].ndim
    columns = [
        arrays[name].reshape(arrays["sigma"].size, *arrays[name].shape[lead:]) for name in (*NEEDED, "weight")
    ]
    return np.concatenate([c.reshape(len(c), -1) for c in columns], 1)


def in_order(found: np.ndarray) -> np.ndarray:
    return found[np.lexsort(found.T)]


@pytest.mark.parametrize("workers", [0, 2])
def test_an_epoch_has_each_query_once(shards: Path, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "_BLOCK", 500)
    monkeypatch.setattr(batches, "_MIXED", 3)
    data, wanted = QueryDataset(shards, batch_size=700, seed=1), stored(shards)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="Length of IterableDataset")
        found = rows(data, workers)
    assert len(DataLoader(data, batch_size=None, num_workers=workers)) == 13
    assert data.count == len(wanted) == 9001
    np.testing.assert_array_equal(in_order(found), in_order(wanted))
    np.testing.assert_array_equal(found, rows(data, workers))
    data.set_epoch(1)
    other = rows(data, workers)
    np.testing.assert_array_equal(in_order(other), in_order(wanted))
    assert (other != found).any(1).mean() > 0.99
    # Batches mix the shards: no batch is of one of them.
    assert sorted({len(batch.sigma) for batch in data}) == [601, 700]
    first = {row.tobytes() for row in wanted[:3000]}
    shares = [np.mean([row.tobytes() in first for row in found[k : k + 1500]]) for k in range(0, 9000, 1500)]
    assert min(shares) > 0
    assert max(shares) < 1


def test_workers_that_stay_follow_the_epoch(shards: Path) -> None:
    data = QueryDataset(shards, "test", seed=1, shuffle=True)
    loader = DataLoader(data, batch_size=None, num_workers=1, persistent_workers=True)
    found = []
    for epoch in (0, 1, 0):
        data.set_epoch(epoch)
        found.append(torch.cat([batch.sigma for batch in loader]).tolist())
    assert found[0] == found[2] != found[1]
    # What a worker gets where processes are not forked.
    received = ForkingPickler.loads(ForkingPickler.dumps(data))
    data.set_epoch(1)
    assert torch.cat([batch.sigma for batch in received]).tolist() == found[1]


def test_test_queries_have_the_order_of_the_shards(shards: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In which predictions are scored; training queries on request."""
    monkeypatch.setattr(batches, "_BLOCK", 70)
    monkeypatch.setattr(batches, "_MIXED", 3)
    for data, split in (
        (QueryDataset(shards, "test", 64), "test"),
        (QueryDataset(shards, shuffle=False), "train"),
    ):
        np.testing.assert_array_equal(rows(data), stored(shards, split))


@pytest.mark.parametrize("layout", ["image", "slices"])
def test_every_layout_is_read(layout: str, tmp_path: Path) -> None:
    folder = tmp_path / "shards"
    if layout == "image":
        write_images(folder, parallax, train=20)
    else:
        write_slices(folder, lights=4, test=50)
    for split in ("train", "test"):
        found = rows(QueryDataset(folder, split))
        np.testing.assert_array_equal(in_order(found), in_order(stored(folder, split)))


def test_what_cannot_be_read_is_refused(shards: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="batch_size"):
        QueryDataset(shards, batch_size=0)
    with pytest.raises(InputError):
        QueryDataset(tmp_path)
    folder = write_data(tmp_path / "shards", constant(1.0), train=100, test=10, shards=1)
    values = np.full((100, 3), np.nan, np.float32)
    rewrite(folder / "train-00000.npz", value_a=values)
    with pytest.raises(InputError, match=r"value_a.*not finite|NaN"):
        next(iter(QueryDataset(folder)))


def test_one_estimate_of_measured_data_stands_for_both(tmp_path: Path) -> None:
    folder = write_data(tmp_path / "shards", parallax, train=300, test=10, noise=NOISE, shards=2)
    edit(folder / "manifest.json", lambda manifest: manifest.update(estimates=1))
    for path in folder.glob("train-*.npz"):
        arrays = dict(np.load(path))
        write_shard(path, {name: arrays[name] for name in ("u", "sigma", "omega_i", "omega_o", "value_a")})
        write_sidecar(
            path, "train", int(path.stem[-5:]), read_checksummed(folder / "manifest.json")["config_hash"]
        )
    found = rows(QueryDataset(folder))
    np.testing.assert_array_equal(in_order(found), in_order(stored(folder)))
    np.testing.assert_array_equal(found[:, 9:12], found[:, 12:15])
