"""Shards as tar files of ``.npy`` members, in the naming of WebDataset.

A sample is a block of consecutive rows: ``train-00000-000003.value_a.npy`` holds the array ``value_a`` of the
fourth block. Rows are queries, images or positions. Times, owners and modes of the members are fixed.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored, write_chunks

# Bytes of the numbers of a sample.
_SAMPLE_BYTES = 1 << 20


def sample_rows(arrays: Arrays) -> int:
    """Rows of one sample: about a megabyte, at least one."""
    total = len(next(iter(arrays.values())))
    return max(1, _SAMPLE_BYTES * total // max(1, sum(array.nbytes for array in arrays.values())))


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
    return write_chunks(path, _chunks(path.stem, arrays))


def _chunks(stem: str, arrays: Arrays) -> Iterator[bytes]:
    rows, total = sample_rows(arrays), len(next(iter(arrays.values())))
    written = 0
    for number, start in enumerate(range(0, total, rows)):
        for name, array in arrays.items():
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.ascontiguousarray(array[start : start + rows]), (1, 0))
            content = stream.getvalue()
            # A new TarInfo has fixed times, owners and modes.
            info = tarfile.TarInfo(f"{stem}-{number:06d}.{name}.npy")
            info.size = len(content)
            member = info.tobuf(tarfile.USTAR_FORMAT) + content
            member += bytes(-len(member) % tarfile.BLOCKSIZE)
            written += len(member)
            yield member
    # Two empty blocks end the archive, which fills whole records.
    yield bytes(2 * tarfile.BLOCKSIZE + -(written + 2 * tarfile.BLOCKSIZE) % tarfile.RECORDSIZE)
