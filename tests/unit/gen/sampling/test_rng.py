"""Random streams: distinct seeds for distinct fields, and no dependence between them."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import uniformity
from support.significance import holm

from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.rng import MAX_SHARDS, Purpose, numpy_generator, stream_key, stream_number

mi = load_mitsuba()

from mbtf_gen.sampling.sobol import SobolSampler, sequence  # noqa: E402

SHARDS = [0, 1, 2, 3, 255, 256, 4095, 4096, 65535, 65536, MAX_SHARDS - 2, MAX_SHARDS - 1]
PASSES = [0, 1, 2, 3, 15, 16, 2047, 4095]
FIELDS = list(itertools.product(("train", "test", "reference"), SHARDS, Purpose, PASSES, (0, 1)))
LANES = 1 << 16


def test_stream_numbers_are_distinct_and_fit_the_key() -> None:
    numbers = [stream_number(*fields) for fields in FIELDS]
    assert len(set(numbers)) == len(FIELDS) == 3 * len(SHARDS) * len(Purpose) * len(PASSES) * 2
    assert min(numbers) >= 0
    assert max(numbers) < 1 << 47
    dense = itertools.product(("train", "test"), range(64), Purpose, range(32), (0, 1))
    assert len({stream_number(*fields) for fields in dense}) == 2 * 64 * len(Purpose) * 32 * 2


def test_numpy_generators_differ_in_every_field() -> None:
    fields = list(itertools.product((0, 1, 2**62), ("train", "test"), (0, 1, 7), Purpose, (0, 1)))
    first = {tuple(numpy_generator(*f).integers(0, 2**63, 2).tolist()) for f in fields}
    assert len(first) == len(fields)


def test_path_keys_differ_in_every_field_and_in_the_root_seed() -> None:
    numbers = [stream_number(*fields) for fields in FIELDS[::7]]
    keys = {stream_key(root, number) for root in (0, 1, 2, 2**62) for number in numbers}
    assert len(keys) == 4 * len(numbers)
    assert max(keys) < 1 << 64


def points(root: int, number: int, query: NDArray[np.uint32], index: NDArray[np.uint32]) -> SobolSampler:
    """Sequences of paths of a stream."""
    key = stream_key(root, number)
    return sequence(mi.UInt32(key & 0xFFFFFFFF), mi.UInt32(key >> 32), mi.UInt32(query), mi.UInt32(index))


def draws(root: int, number: int, count: int) -> NDArray[np.float64]:
    """(count, LANES) numbers in [0, 1) of the first path of the first `LANES` queries of a stream."""
    sampler = points(root, number, np.arange(LANES, dtype=np.uint32), np.zeros(LANES, np.uint32))
    numbers = [sampler.next_1d() for _ in range(count)]
    # One kernel for all of them.
    dr.eval(numbers)
    return np.array([np.array(row, np.float64) for row in numbers])


BASE = (0, "train", 0, Purpose.PATH, 0, 0)
NEIGHBORS = {
    "half": (0, "train", 0, Purpose.PATH, 0, 1),
    "shard": (0, "train", 1, Purpose.PATH, 0, 0),
    "pass": (0, "train", 0, Purpose.PATH, 1, 0),
    "purpose": (0, "train", 0, Purpose.FOOTPRINT, 0, 0),
    "split": (0, "test", 0, Purpose.PATH, 0, 0),
    "root": (1, "train", 0, Purpose.PATH, 0, 0),
}


@pytest.mark.parametrize("field", NEIGHBORS)
def test_streams_that_differ_in_one_field_are_independent(field: str) -> None:
    """Each of the first 40 numbers of a path against that of the same path in the neighboring stream."""
    pair = [draws(f[0], stream_number(*f[1:]), 40) for f in (BASE, NEIGHBORS[field])]
    p = [uniformity(x, y) for x, y in zip(*pair, strict=True)]
    assert holm(p).min() > 1e-3


def test_queries_of_one_stream_are_independent() -> None:
    numbers = draws(0, stream_number(*BASE[1:]), 20)
    p = [
        uniformity(*pair)
        for row in numbers
        for pair in ((row[:-1:2], row[1::2]), (row[: LANES // 2], row[LANES // 2 :]))
    ]
    assert holm(p).min() > 1e-3


def test_a_path_does_not_depend_on_its_launch() -> None:
    query = np.array([5, 70000, 3, 2**32 - 1], np.uint32)
    index = np.array([0, 3, 900, 2**31], np.uint32)
    number = stream_number(*BASE[1:])
    together = np.array(points(9, number, query, index).next_2d()).T
    alone = [
        np.array(points(9, number, query[i : i + 1], index[i : i + 1]).next_2d())[:, 0] for i in range(4)
    ]
    assert together.tolist() == [x.tolist() for x in alone]
