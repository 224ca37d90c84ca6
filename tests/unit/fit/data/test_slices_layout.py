"""Reading of the slices layout: texels in order, directions held out, damaged data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.datasets import rewrite
from support.slice_data import write_slices

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import read_shard
from mbtf_core.errors import InputError
from mbtf_fit.data.layouts import DECODED, SharedSlices, TrainingSlices
from mbtf_fit.data.loader import load_training
from mbtf_fit.sections import HeldOutSection


def place(u, sigma, omega_i, omega_o):  # type: ignore[no-untyped-def]
    """Position and directions as a color."""
    return np.stack([u[:, 0], u[:, 1], omega_i[:, 0] + 2 * omega_o[:, 1]], axis=-1)


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_slices_are_in_the_order_of_the_texels(tmp_path: Path, aspect: float) -> None:
    data = Dataset.open(write_slices(tmp_path / "data", place, aspect=aspect))
    found = load_training(data, HeldOutSection(queries=0.05), 0)
    slices = found.training
    assert isinstance(slices, TrainingSlices)
    rows, columns = data.lattice.shape()
    j, i = np.divmod(np.arange(rows * columns), columns)
    values = slices.values.numpy()
    np.testing.assert_allclose(values[:, 0, 0], (i + 0.5) / columns, atol=1e-6)
    np.testing.assert_allclose(values[:, 0, 1], 1 - (j + 0.5) / rows, atol=1e-6)
    expected = slices.omega_i[:, 0] + 2 * slices.omega_o[:, 1]
    np.testing.assert_allclose(values[3, :, 2], expected.numpy(), atol=1e-6)


def test_held_out_pairs_are_not_trained_on(tmp_path: Path) -> None:
    data = Dataset.open(write_slices(tmp_path / "data"))
    found = load_training(data, HeldOutSection(queries=0.1, radius=0.2), 0)
    slices = found.training
    assert isinstance(slices, TrainingSlices)
    pairs = {tuple(p) for p in torch.cat([slices.omega_i, slices.omega_o], 1).tolist()}
    for held in (found.held_out_queries, found.held_out_directions):
        assert len(held) > 100
        assert not pairs & {tuple(p) for p in np.concatenate([held.omega_i, held.omega_o], 1).tolist()}
    for omega in (slices.omega_i, slices.omega_o):
        assert ((omega[:, :2] - torch.tensor([0.45, 0.3])).square().sum(1) >= 0.2**2).all()
    sampled = np.concatenate([found.sample.omega_i, found.sample.omega_o], 1).tolist()
    assert {tuple(p) for p in sampled} <= pairs
    assert len(pairs) < 100


def test_a_batch_decodes_pairs_of_whole_slices(tmp_path: Path) -> None:
    found = load_training(Dataset.open(write_slices(tmp_path / "data")), HeldOutSection(), 0)
    slices = found.training
    assert isinstance(slices, TrainingSlices)
    batch, again = next(slices.batches(640, 1, 5)), next(slices.batches(640, 1, 5))
    assert len(batch) == 640 // DECODED
    assert torch.equal(batch.chosen, again.chosen)
    assert torch.equal(batch.values, again.values)
    queries = batch.queries()
    k = batch.chosen.shape[1]
    assert torch.equal(queries.value[k + 2], batch.values[1, batch.chosen[1, 2]])
    assert torch.equal(queries.omega_o[k + 2], batch.omega_o[batch.chosen[1, 2]])
    # Other steps have other texels.
    assert not torch.equal(batch.values, next(slices.batches(640, 1, 6)).values)
    shared = SharedSlices(slices, [slices.scaled(2.0), slices])
    assert len(shared) == 2 * len(slices)
    assert torch.equal(next(shared.batches(640, 1, 4)).values, 2 * next(slices.batches(640, 1, 4)).values)


def test_slices_are_queries_in_random_order(tmp_path: Path) -> None:
    data = Dataset.open(write_slices(tmp_path / "data", place, aspect=0.5))
    slices = load_training(data, HeldOutSection(queries=0.05), 0).training
    assert isinstance(slices, TrainingSlices)
    queries = slices.as_queries(data.lattice, 3)
    expected = place(queries.u.numpy(), None, queries.omega_i.numpy(), queries.omega_o.numpy())
    np.testing.assert_allclose(queries.value.numpy(), expected, atol=1e-6)
    assert len(torch.unique(torch.cat([queries.u, queries.omega_i, queries.omega_o], 1), dim=0)) == len(
        slices
    )
    # A batch has queries of the whole tile.
    assert queries.u[:200].std(0).numpy() == pytest.approx(12**-0.5, abs=0.05)
    assert not torch.equal(queries.u, slices.as_queries(data.lattice, 4).u)


@pytest.mark.parametrize(
    ("name", "changed", "message"),
    [
        ("omega_i", lambda a: a[1][::-1], "do not share their directions"),
        ("u", lambda a: a[0], "lacks slices of some texels"),
    ],
)
def test_damaged_slices_are_refused(tmp_path: Path, name: str, changed: Any, message: str) -> None:
    shards = write_slices(tmp_path / "data")
    array = read_shard(shards / "train-00000.npz", mapped=False)[name].copy()
    array[1] = changed(array)
    rewrite(shards / "train-00000.npz", **{name: array})
    with pytest.raises(InputError, match=message):
        load_training(Dataset.open(shards), HeldOutSection(), 0)
