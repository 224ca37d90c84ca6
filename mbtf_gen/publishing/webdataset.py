"""Shards as tar files of ``.npy`` members, in the naming of WebDataset.

A sample is a block of consecutive rows: ``train-00000-000003.value_a.npy`` holds the array ``value_a`` of the
fourth block. Rows are queries, images or positions.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored, write_through

# Bytes of the numbers of a sample.
_SAMPLE_BYTES = 1 << 20


def write_tar(path: Path, arrays: Arrays) -> Stored:
    """Write a shard as a tar file, atomically; the bytes depend on the arrays and the name alone.

    Parameters
    ----------
    path : Path
        File to write; its stem begins the names of the samples.
    arrays : dict of str to float32 array
        Of one shard.

    Returns
    -------
    Stored

    Raises
    ------
    PartialError
        The disk is full or the folder cannot be written.
    """
    from webdataset import TarWriter

    total = len(next(iter(arrays.values())))
    rows = max(1, _SAMPLE_BYTES * total // max(1, sum(array.nbytes for array in arrays.values())))

    def write(temporary: Path) -> None:
        with (
            temporary.open("wb") as stream,
            TarWriter(stream, user="", group="", mode=0o644, mtime=0, compress=False) as tar,
        ):
            for number, start in enumerate(range(0, total, rows)):
                block = {f"{n}.npy": np.ascontiguousarray(a[start : start + rows]) for n, a in arrays.items()}
                tar.write({"__key__": f"{path.stem}-{number:06d}", **block})

    return write_through(path, write)
