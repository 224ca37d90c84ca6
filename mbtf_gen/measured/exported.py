"""Data sets as HDF5 files of other programs, whose formats :mod:`mbtf_gen.measured.hdf5` describes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.shard_files import Arrays
from mbtf_core.errors import InputError
from mbtf_core.extras import import_extra
from mbtf_core.files.atomic import write_through
from mbtf_gen.measured.hdf5 import CHANNELS, COLOR, LIGHT, PLACE, RADIUS, VIEW

# Largest images that NeuMIP's queries are arranged in.
_LARGEST = 512


def mean_of(arrays: Arrays) -> NDArray[np.float32]:
    """Values (..., 3): the mean of both estimates, or the only one."""
    first = arrays["value_a"]
    return np.float32(0.5) * first + np.float32(0.5) * arrays.get("value_b", first)


def export_neumip(data: Dataset, path: Path) -> int:
    """Write the training queries of a data set, shuffled and of a square tile, for NeuMIP's code, which
    trains on whole images of them. Returns the number of queries written: the last ones that do not fill an
    image are left out. Errors are an InputError; the path is replaced only once all queries are written."""
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
    count, side = sum(shard.rows for shard in data.shards("train")), _LARGEST
    while side > 1 and side * side > count:
        side //= 2
    images = count // side**2

    h5py = import_extra("h5py", path)

    def write(temporary: Path) -> None:
        with h5py.File(temporary, "w") as file:
            file.attrs["base_radius"] = 0.5 / (1 << data.lattice.finest)
            stored = {
                name: file.create_dataset(
                    name, (images, side, side, c), np.float32, chunks=(1, side, side, c)
                )
                for name, c in CHANNELS.items()
            }
            waiting = {name: np.empty((0, c), np.float32) for name, c in CHANNELS.items()}
            done = 0
            for arrays in data.iterate("train"):
                rows = _neumip_queries(arrays)
                waiting = {name: np.concatenate([waiting[name], rows[name]]) for name in waiting}
                new = len(waiting[COLOR]) // side**2
                for name, channels in CHANNELS.items():
                    whole, waiting[name] = np.split(waiting[name], [new * side**2])
                    stored[name][done : done + new] = whole.reshape(new, side, side, channels)
                done += new

    write_through(path, write)
    return images * side**2


def _neumip_queries(arrays: Arrays) -> Arrays:
    """Our queries in NeuMIP's conventions."""
    found = {
        COLOR: mean_of(arrays),
        PLACE: 2.0 * arrays["u"].astype(np.float64) - 1.0,
        RADIUS: arrays["sigma"][:, None],
        VIEW: -arrays["omega_o"][:, :2],
        LIGHT: -arrays["omega_i"][:, :2],
    }
    return {name: np.asarray(array, np.float32) for name, array in found.items()}


def export_neural_btf(data: Dataset, path: Path) -> int:
    """Write the images of all pairs of light and view of a data set of the slices layout for NeuralBTF's
    code. Returns the number of values written; errors and path as of :func:`export_neumip`."""
    if data.layout != "slices":
        raise InputError(
            f"has the {data.layout} layout, but NeuralBTF learns from images under fixed lights and views",
            where=data.folder,
            hint="generate it with --layout slices",
        )
    rows, columns = data.lattice.shape()
    whole = data.load("train")
    values = mean_of(whole)[np.argsort(data.lattice.texel_of(whole["u"][:, 0]))].reshape(rows, columns, -1, 3)

    h5py = import_extra("h5py", path)

    def write(temporary: Path) -> None:
        with h5py.File(temporary, "w") as file:
            file[LIGHT], file[VIEW] = whole["omega_i"][0, :, :2], whole["omega_o"][0, :, :2]
            color: Any = file.create_dataset(COLOR, (values.shape[2], rows, columns, 3), np.float32)
            for pair in range(values.shape[2]):
                color[pair] = values[:, :, pair]

    write_through(path, write)
    return int(values.size // 3)
