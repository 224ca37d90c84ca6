"""Data sets as files of other programs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import Arrays
from mbtf_core.errors import InputError
from mbtf_gen.measured.neumip_hdf5 import write_neumip
from mbtf_gen.measured.neural_btf_hdf5 import write_neural_btf

# Largest images that NeuMIP's queries are arranged in.
_LARGEST = 512


def mean_of(arrays: Arrays) -> NDArray[np.float32]:
    """Values (..., 3): the mean of both estimates, or the only one."""
    first = arrays["value_a"]
    return np.float32(0.5) * first + np.float32(0.5) * arrays.get("value_b", first)


def export_neumip(data: Dataset, path: Path) -> int:
    """Write the training queries for NeuMIP's code; returns how many.

    Raises
    ------
    InputError : the shards or the file cannot be used
    """
    count = sum(shard.rows for shard in data.shards("train"))
    if data.layout != "shuffled":
        raise InputError(
            f"has the {data.layout} layout, but NeuMIP learns from shuffled queries",
            where=data.folder,
            hint="generate it with --layout shuffled",
        )
    if data.lattice.aspect != 1.0:
        raise InputError(
            f"has the aspect {data.lattice.aspect:g}, but NeuMIP's tiles are square",
            where=data.folder,
            hint="generate it from a square tile",
        )
    side = _LARGEST
    while side > 1 and side * side > count:
        side //= 2
    batches = ({**arrays, "value": mean_of(arrays)} for arrays in data.iterate("train"))
    return write_neumip(path, batches, 1 << data.lattice.finest, (side, side))


def export_neural_btf(data: Dataset, path: Path) -> int:
    """Write the images of all pairs of light and view for NeuralBTF's code; returns how many values.

    Raises
    ------
    InputError : the data set has no such images, or the file cannot be written
    """
    if data.layout != "slices":
        raise InputError(
            f"has the {data.layout} layout, but NeuralBTF learns from images under fixed lights and views",
            where=data.folder,
            hint="generate it with --layout slices",
        )
    rows, columns = data.lattice.shape()
    whole = data.load("train")
    values = mean_of(whole)[np.argsort(data.lattice.texel_of(whole["u"][:, 0]))].reshape(rows, columns, -1, 3)

    def images() -> Iterator[NDArray[np.float32]]:
        for pair in range(values.shape[2]):
            yield values[:, :, pair]

    write_neural_btf(path, whole["omega_i"][0], whole["omega_o"][0], images())
    return int(values.size // 3)
