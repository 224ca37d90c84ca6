"""Shards as Parquet files: one column per array, one row per query, image or position.

A column of several numbers per row is a fixed-size list of float32, nested as deep as the array has axes.
Units and meanings are metadata of the columns. Pages are encoded by BYTE_STREAM_SPLIT and compressed by
Zstandard: both are lossless.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored, write_through

# Bytes of the numbers of one row group.
_GROUP_BYTES = 32 << 20


def write_parquet(path: Path, arrays: Arrays, described: Mapping[str, Mapping[str, Any]]) -> Stored:
    """Write a shard as Parquet, atomically; the bytes depend on the arguments and on pyarrow alone.

    Parameters
    ----------
    path : Path
        File to write.
    arrays : dict of str to float32 array
        Of one shard.
    described : mapping
        ``unit`` and ``meaning`` of each array.

    Returns
    -------
    Stored

    Raises
    ------
    PartialError
        The disk is full or the folder cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields = []
    for name, array in arrays.items():
        metadata = {key: str(described[name][key]) for key in ("unit", "meaning")}
        metadata["shape"] = json.dumps([-1, *array.shape[1:]])
        fields.append(pa.field(name, _column(array[:1]).type, nullable=False, metadata=metadata))
    schema = pa.schema(fields)
    total = len(next(iter(arrays.values())))
    row = sum(array.nbytes for array in arrays.values()) // max(total, 1)
    rows = max(1, _GROUP_BYTES // max(row, 1))

    def write(temporary: Path) -> None:
        with pq.ParquetWriter(
            temporary, schema, compression="zstd", use_dictionary=False, use_byte_stream_split=True
        ) as writer:
            for start in range(0, total, rows):
                part = [_column(array[start : start + rows]) for array in arrays.values()]
                writer.write_table(pa.Table.from_arrays(part, schema=schema))

    return write_through(path, write)


def _column(array: NDArray[np.float32]) -> Any:
    """A column of nested lists of fixed size, without a copy of its numbers."""
    import pyarrow as pa

    column = pa.array(np.ascontiguousarray(array).reshape(-1), pa.float32())
    for size in reversed(array.shape[1:]):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column
