"""Sequences of paths: stratified within a half of a query, uniform and independent in every other respect."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import uniformity
from support.significance import holm

from mbtf_core.stats import mean_estimate, t_test
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.sampling.rng import Purpose, stream_key, stream_number

mi = load_mitsuba()

from mbtf_gen.sampling.sobol import SobolSampler, sequence  # noqa: E402

QUERIES = 2048
LENGTH = 16


def points(queries: int = QUERIES, length: int = LENGTH, half: int = 0, root: int = 0) -> SobolSampler:
    """The first points of `queries` sequences, query by query."""
    key = stream_key(root, stream_number("train", 0, Purpose.PATH, 0, half))
    return sequence(
        mi.UInt32(key & 0xFFFFFFFF),
        mi.UInt32(key >> 32),
        mi.UInt32(np.repeat(np.arange(queries, dtype=np.uint32), length)),
        mi.UInt32(np.tile(np.arange(length, dtype=np.uint32), queries)),
    )


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
    """How many of eight points lie in the upper half of two dimensions: one order for all would make it 0 or
    4."""
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
