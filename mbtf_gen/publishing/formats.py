"""The published forms of a shard: Parquet, or the shard as it is.

Parquet has one column per array, one row per query, image or position. A column of several numbers per row
is a fixed-size list of float32, nested as deep as the array has axes. Units and meanings are its metadata.
Pages are encoded by BYTE_STREAM_SPLIT and compressed by Zstandard: both are lossless.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Shard
from mbtf_core.data.folder import sidecar_name
from mbtf_core.data.shard_files import Arrays
from mbtf_core.extras import import_extra
from mbtf_core.files.atomic import Stored, file_sha256, sync_folder, temporary_of, write_chunks, write_through
from mbtf_gen.config.exchange import Form

Described = Mapping[str, Mapping[str, Any]]
# Suffix of a shard in each form.
SUFFIXES: dict[Form, str] = {"parquet": ".parquet", "npz": ".npz"}
# Bytes of the numbers of a row group of Parquet.
_GROUP_BYTES = 32 << 20
_CHUNK = 1 << 20


def published_names(shard: Shard, form: Form) -> list[str]:
    """Names of the files that a shard becomes."""
    name = shard.file.rpartition(".")[0] + SUFFIXES[form]
    return [name, sidecar_name(name)] if form == "npz" else [name]


def shard_writers(
    shard: Shard, arrays: Arrays, form: Form, described: Described
) -> dict[str, Callable[[Path], Stored]]:
    """What writes each file of :func:`published_names` to a path, atomically.

    The bytes of Parquet files depend on the arrays, on `described`, their units and meanings, and on the
    library alone.
    """
    first, *rest = published_names(shard, form)
    if form == "npz":
        return {first: lambda path: copied(shard.local(), path, link=True)} | {
            name: lambda path, name=name: write_chunks(path, [shard.folder.read(name)]) for name in rest
        }
    return {first: partial(write_parquet, arrays=arrays, described=described)}


def write_parquet(path: Path, arrays: Arrays, described: Described) -> Stored:
    """Write arrays (rows, …) as Parquet, atomically."""
    pa, pq = (import_extra(name, path) for name in ("pyarrow", "pyarrow.parquet"))
    fields = []
    for name, array in arrays.items():
        metadata = {key: str(described[name][key]) for key in ("unit", "meaning")}
        metadata["shape"] = json.dumps([-1, *array.shape[1:]])
        fields.append(pa.field(name, _column(array[:1]).type, nullable=False, metadata=metadata))
    schema = pa.schema(fields)
    total = len(next(iter(arrays.values())))
    rows = max(1, _GROUP_BYTES * total // max(1, sum(array.nbytes for array in arrays.values())))

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
    pa = import_extra("pyarrow", "--form parquet")
    column = pa.array(np.ascontiguousarray(array).reshape(-1), pa.float32())
    for size in reversed(array.shape[1:]):
        column = pa.FixedSizeListArray.from_arrays(column, size)
    return column


def copied(source: Path, path: Path, *, link: bool = False) -> Stored:
    """A copy of a file, atomically; a hard link if asked for and the disk has them.

    Shards are replaced, never changed in place, so that a link keeps its content.
    """
    if link:
        temporary = temporary_of(path)
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
            os.link(source, temporary)
            os.replace(temporary, path)
            # A rename does nothing if both names are links to one file already.
            temporary.unlink(missing_ok=True)
            sync_folder(path.parent)
            return Stored(path.stat().st_size, file_sha256(path))
    with source.open("rb") as stream:
        return write_chunks(path, iter(lambda: stream.read(_CHUNK), b""))
