"""Random streams and sequences of paths: distinct, independent, uniform; stratified within a query's half."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import uniformity
from support.significance import holm

from mbtf_core.stats import mean_estimate, t_test
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.rng import MAX_SHARDS, Purpose, numpy_generator, stream_key, stream_number

mi = load_mitsuba()

from mbtf_gen.sampling.sobol import SobolSampler, sequence  # noqa: E402

QUERIES = 2048
LENGTH = 16


def stream_points(
    root: int, number: int, query: NDArray[np.uint32], index: NDArray[np.uint32]
) -> SobolSampler:
    """Sequences of paths of a stream."""
    key = stream_key(root, number)
    return sequence(mi.UInt32(key & 0xFFFFFFFF), mi.UInt32(key >> 32), mi.UInt32(query), mi.UInt32(index))


def points(queries: int = QUERIES, length: int = LENGTH, half: int = 0, root: int = 0) -> SobolSampler:
    """The first points of `queries` sequences, query by query."""
    query, index = (a.astype(np.uint32).ravel() for a in np.mgrid[:queries, :length])
    return stream_points(root, stream_number("train", 0, Purpose.PATH, 0, half), query, index)


def pairs(sampler: SobolSampler, length: int = LENGTH) -> NDArray[np.float64]:
    """(queries, length, 2) coordinates of the next dimension."""
    return np.array(sampler.next_2d(), np.float64).T.reshape(-1, length, 2)


def test_two_coordinates_fill_every_elementary_interval_once() -> None:
    sampler = points(256)
    for _ in range(6):
        xy = pairs(sampler)
        for m, start in itertools.product(range(1, 5), (0, 8)):
            n = 1 << m
            if start % n or start + n > LENGTH:
                continue
            for j in range(m + 1):
                column = np.floor(xy[:, start : start + n, 0] * (1 << j))
                row = np.floor(xy[:, start : start + n, 1] * (1 << (m - j)))
                box = np.sort(column * (1 << (m - j)) + row, axis=1)
                assert (box == np.arange(n)).all(), (m, j, start)


def test_one_coordinate_is_stratified() -> None:
    sampler = points(256)
    for _ in range(6):
        x = np.array(sampler.next_1d(), np.float64).reshape(-1, LENGTH)
        for n in (2, 4, 8, 16):
            assert (np.sort(np.floor(x[:, :n] * n), axis=1) == np.arange(n)).all()


@pytest.mark.parametrize("index", [0, 1, 7])
def test_every_point_of_a_sequence_is_uniform(index: int) -> None:
    """Over queries; else estimates would be biased for numbers of paths that fill no net."""
    sampler = points(1 << 15, 8)
    p = [uniformity(*pairs(sampler, 8)[:, index].T) for _ in range(4)]
    assert holm(p).min() > 1e-3


def test_dimensions_of_a_point_are_independent_of_each_other() -> None:
    sampler = points(1 << 14, 4)
    columns = [c for _ in range(4) for c in np.moveaxis(pairs(sampler, 4), -1, 0)]
    p = [uniformity(x[:, 1], y[:, 1]) for x, y in itertools.combinations(columns, 2)]
    assert holm(p).min() > 1e-3


def test_the_order_of_points_differs_between_dimensions() -> None:
    """Of eight points, how many lie in the upper half of both: one order for all would make it 0 or 4."""
    sampler = points(1 << 15, 8)
    first, second = (np.array(sampler.next_1d(), np.float64).reshape(-1, 8) > 0.5 for _ in range(2))
    both = (first & second).sum(axis=1).astype(np.float64)
    assert t_test(mean_estimate(both), 2.0).p_value > 1e-3
    # Independent points: 8 · 1/4 · 3/4.
    assert both.var() < 0.7 * 1.5


def test_halves_are_independent() -> None:
    """In each of the first dimensions, and of one dimension from another."""
    first, second = (points(1 << 13, 4, half) for half in (0, 1))
    a, b = ([pairs(sampler, 4) for _ in range(4)] for sampler in (first, second))
    p = []
    for m, n in [(0, 0), (1, 1), (2, 2), (3, 3), (0, 2), (3, 1)]:
        p += [
            uniformity(a[m][:, i, k], b[n][:, j, k]) for i, j, k in itertools.product((0, 3), (0, 3), (0, 1))
        ]
        # Means over a half as well, which within one net hardly vary.
        product = [(a[m][..., k].mean(axis=1) - 0.5) * (b[n][..., k].mean(axis=1) - 0.5) for k in (0, 1)]
        p += [t_test(mean_estimate(x)).p_value for x in product]
    assert holm(p).min() > 1e-3


@pytest.mark.parametrize("length", [3, 5, 6, 7])
def test_lengths_that_fill_no_net_are_unbiased_and_no_worse_than_independent_points(length: int) -> None:
    """Halves of 3 · 2^m paths, as counts under a target error have them, and other odd ones."""
    first, second = (points(1 << 13, length, half) for half in (0, 1))
    exact = (1 - np.cos(3.0)) / 3.0 * (np.e - 1)
    means = []
    for sampler in (first, second):
        sampler.next_2d()
        xy = pairs(sampler, length)
        value = np.sin(3.0 * xy[..., 0]) * np.exp(xy[..., 1])
        means.append(value.mean(axis=1) - exact)
        assert t_test(mean_estimate(means[-1])).p_value > 1e-3
        assert means[-1].var() < value.var() / length
        # The net within them is whole.
        net = 1 << (length.bit_length() - 1)
        for start in range(0, length - net + 1, net):
            column = np.sort(np.floor(xy[:, start : start + net, 0] * net), axis=1)
            assert (column == np.arange(net)).all()
    assert t_test(mean_estimate(means[0] * means[1])).p_value > 1e-3


def test_plain_numbers_are_uniform_and_leave_the_dimensions_alone() -> None:
    plain, sampler = points(1 << 12), points(1 << 12)
    numbers = np.array([np.array(plain.chance(), np.float64) for _ in range(2)])
    assert uniformity(*numbers) > 1e-3
    assert uniformity(numbers[0, :-1:2], numbers[0, 1::2]) > 1e-3
    assert (pairs(plain) == pairs(sampler)).all()


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


@pytest.mark.parametrize(
    ("shard", "pass_index", "half"), [(-1, 0, 0), (MAX_SHARDS, 0, 0), (0, 4096, 0), (0, 0, 2)]
)
def test_fields_beyond_their_bits_are_refused(shard: int, pass_index: int, half: int) -> None:
    with pytest.raises(ValueError, match=r"shard|pass"):
        stream_number("train", shard, Purpose.PATH, pass_index, half)


def test_numpy_generators_differ_in_every_field() -> None:
    fields = list(itertools.product((0, 1, 2**62), ("train", "test"), (0, 1, 7), Purpose, (0, 1)))
    first = {tuple(numpy_generator(*f).integers(0, 2**63, 2).tolist()) for f in fields}
    assert len(first) == len(fields)


def test_path_keys_differ_in_every_field_and_in_the_root_seed() -> None:
    numbers = [stream_number(*fields) for fields in FIELDS[::7]]
    keys = {stream_key(root, number) for root in (0, 1, 2, 2**62) for number in numbers}
    assert len(keys) == 4 * len(numbers)
    assert max(keys) < 1 << 64


def draws(root: int, number: int, count: int) -> NDArray[np.float64]:
    """(count, LANES) numbers in [0, 1) of the first path of the first `LANES` queries of a stream."""
    sampler = stream_points(root, number, np.arange(LANES, dtype=np.uint32), np.zeros(LANES, np.uint32))
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
    together = np.array(stream_points(9, number, query, index).next_2d()).T
    alone = [
        np.array(stream_points(9, number, query[i : i + 1], index[i : i + 1]).next_2d())[:, 0]
        for i in range(4)
    ]
    assert together.tolist() == [x.tolist() for x in alone]
