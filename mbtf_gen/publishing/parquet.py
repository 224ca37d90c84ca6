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
from mbtf_core.errors import EngineError
from mbtf_core.files.atomic import Stored, write_through

# Bytes of the numbers of one row group.
_GROUP_BYTES = 32 << 20


def check_pyarrow() -> None:
    """Refuse to go on without pyarrow.

    Raises
    ------
    EngineError : it is not installed
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise EngineError(
            "pyarrow is not installed, which writes Parquet files",
            where="--form parquet",
            hint="pip install 'mbtf[publish]', or use --form webdataset or --form npz",
        ) from None


def parquet_schema(
    arrays: Arrays, described: Mapping[str, Mapping[str, Any]], facts: Mapping[str, Any]
) -> Any:
    """Schema of the Parquet file of a shard.

    Parameters
    ----------
    arrays : dict of str to float32 array
        Of one shard.
    described : mapping
        ``unit`` and ``meaning`` of each array.
    facts : mapping
        Plain data for the metadata of the file.

    Returns
    -------
    pyarrow.Schema
    """
    import pyarrow as pa

    fields = []
    for name, array in arrays.items():
        kind = pa.float32()
        for size in reversed(array.shape[1:]):
            kind = pa.list_(kind, size)
        metadata = {key: str(described[name][key]) for key in ("unit", "meaning")}
        metadata["shape"] = json.dumps([-1, *array.shape[1:]])
        fields.append(pa.field(name, kind, nullable=False, metadata=metadata))
    return pa.schema(fields, metadata={"mbtf": json.dumps(facts)})


def _column(array: NDArray[np.float32], kind: Any) -> Any:
    """A column of fixed-size lists without a copy of its numbers."""
    import pyarrow as pa

    types = [kind]
    while pa.types.is_fixed_size_list(types[-1]):
        types.append(types[-1].value_type)
    column = pa.array(np.ascontiguousarray(array).reshape(-1), pa.float32())
    for one in reversed(types[:-1]):
        column = pa.FixedSizeListArray.from_arrays(column, type=one)
    return column


def write_parquet(
    path: Path, arrays: Arrays, described: Mapping[str, Mapping[str, Any]], facts: Mapping[str, Any]
) -> Stored:
    """Write a shard as Parquet, atomically; the bytes depend on the arguments and on pyarrow alone.

    Parameters
    ----------
    path : Path
        File to write.
    arrays, described, facts
        As for :func:`parquet_schema`.

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

    schema = parquet_schema(arrays, described, facts)
    total = len(next(iter(arrays.values())))
    row = sum(array.nbytes for array in arrays.values()) // max(total, 1)
    rows = max(1, _GROUP_BYTES // max(row, 1))

    def write(temporary: Path) -> None:
        with pq.ParquetWriter(
            temporary, schema, compression="zstd", use_dictionary=False, use_byte_stream_split=True
        ) as writer:
            for start in range(0, total, rows):
                part = [_column(a[start : start + rows], schema.field(n).type) for n, a in arrays.items()]
                writer.write_table(pa.Table.from_arrays(part, schema=schema))

    return write_through(path, write)
