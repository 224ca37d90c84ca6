"""The published forms of a shard: Parquet, tar files of WebDataset, or the shard as it is.

- Parquet has one column per array, one row per query, image or position. A column of several numbers per row
  is a fixed-size list of float32, nested as deep as the array has axes. Units and meanings are its metadata.
  Pages are encoded by BYTE_STREAM_SPLIT and compressed by Zstandard: both are lossless.
- A sample of a tar file is a block of consecutive rows: ``train-00000-000003.value_a.npy`` holds the array
  ``value_a`` of the fourth block.
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
from mbtf_gen.config.publish import Form

Described = Mapping[str, Mapping[str, Any]]
# Suffix of a shard in each form, and the library that writes or describes it.
SUFFIXES: dict[Form, str] = {"parquet": ".parquet", "webdataset": ".tar", "npz": ".npz"}
LIBRARIES: dict[Form, str] = {"parquet": "pyarrow", "webdataset": "webdataset", "npz": "mlcroissant"}
# Bytes of the numbers of a row group of Parquet, and of a sample of a tar file.
_GROUP_BYTES, _SAMPLE_BYTES = 32 << 20, 1 << 20
_CHUNK = 1 << 20


def published_names(shard: Shard, form: Form) -> list[str]:
    """Names of the files that a shard becomes."""
    name = shard.file.rpartition(".")[0] + SUFFIXES[form]
    return [name, sidecar_name(name)] if form == "npz" else [name]


def shard_writers(
    shard: Shard, arrays: Arrays, form: Form, described: Described
) -> dict[str, Callable[[Path], Stored]]:
    """What writes each file of :func:`published_names` to a path, atomically.

    The bytes of Parquet and tar files depend on the arrays, on `described`, their units and meanings, and on
    the library alone.
    """
    first, *rest = published_names(shard, form)
    if form == "npz":
        return {first: lambda path: copied(shard.local(), path, link=True)} | {
            name: lambda path, name=name: write_chunks(path, [shard.folder.read(name)]) for name in rest
        }
    if form == "parquet":
        return {first: partial(write_parquet, arrays=arrays, described=described)}
    return {first: partial(write_tar, arrays=arrays)}


def write_parquet(path: Path, arrays: Arrays, described: Described) -> Stored:
    """Write arrays (rows, …) as Parquet, atomically."""
    pa, pq = (import_extra(name, path) for name in ("pyarrow", "pyarrow.parquet"))
    fields = []
    for name, array in arrays.items():
        metadata = {key: str(described[name][key]) for key in ("unit", "meaning")}
        metadata["shape"] = json.dumps([-1, *array.shape[1:]])
        fields.append(pa.field(name, _column(array[:1]).type, nullable=False, metadata=metadata))
    schema = pa.schema(fields)
    total, rows = _blocks(arrays, _GROUP_BYTES)

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


def write_tar(path: Path, arrays: Arrays) -> Stored:
    """Write arrays (rows, …) as a tar file whose samples have the name of the file, atomically."""
    webdataset = import_extra("webdataset", path)

    total, rows = _blocks(arrays, _SAMPLE_BYTES)

    def write(temporary: Path) -> None:
        with (
            temporary.open("wb") as stream,
            webdataset.TarWriter(stream, user="", group="", mode=0o644, mtime=0, compress=False) as tar,
        ):
            for number, start in enumerate(range(0, total, rows)):
                block = {f"{n}.npy": np.ascontiguousarray(a[start : start + rows]) for n, a in arrays.items()}
                tar.write({"__key__": f"{path.stem}-{number:06d}", **block})

    return write_through(path, write)


def _blocks(arrays: Arrays, size: int) -> tuple[int, int]:
    """Number of rows, and how many of them take so many bytes."""
    total = len(next(iter(arrays.values())))
    return total, max(1, size * total // max(1, sum(array.nbytes for array in arrays.values())))


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
