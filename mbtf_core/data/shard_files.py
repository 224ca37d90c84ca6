"""One shard on disk: npz (uncompressed, memory-mappable) or EXR (named float32 channels).

A shard is a mapping of array name to array; all arrays share their leading axes: ``(n,)`` queries in the
``shuffled`` layout, ``(items, rows, columns)`` in the ``image`` layout,
``(items, directions)`` in the ``slices`` layout. See the data-format page.
"""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from mbtf_core.data.schema import ARRAY, ARRAYS
from mbtf_core.errors import InputError, reason
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_core.paths import refuse_special

Arrays = dict[str, NDArray[np.float32]]

# Width of the EXR images that shuffled queries are folded into.
_FOLD_WIDTH = 1024
# An EXR header that states more is corrupt.
_MAX_PIXELS = 2**31
# Offsets of arrays in an npz archive are multiples of this, so that mapped arrays are aligned.
_ALIGNMENT = 64
# Bytes of a local header without name and extra fields, and of the extra field of 64-bit sizes (APPNOTE.TXT
# 6.3.3, sections 4.3.7 and 4.5.3).
_HEADER, _SIZES_64 = 30, 20
# Unit vectors: largest distance of a squared length from 1. Computing in float32 gives 1e-6 at most.
_UNIT_TOLERANCE = 1e-5
# Values of the queries that are checked at once, so that temporary arrays stay in the cache.
_CHECKED = 1 << 16


def row_bytes(holes: bool) -> int:
    """Bytes of one query in a shard."""
    absent = {"weight"} if holes else {"weight", "transmittance"}
    return sum(4 * max(1, math.prod(a.trailing)) for a in ARRAYS if a.name not in absent)


def check_arrays(
    arrays: Mapping[str, NDArray[np.float32]], where: object, *, complete: bool = True
) -> tuple[int, ...]:
    """Leading axes shared by arrays of a shard; an InputError where an array is unknown, of the wrong shape
    or, unless the shard need not be `complete`, missing."""
    missing = [a.name for a in ARRAYS if complete and not a.optional and a.name not in arrays]
    if missing:
        raise InputError(f"shard lacks the array(s) {', '.join(missing)}", where=where)
    leads = set()
    for name, array in arrays.items():
        if name not in ARRAY:
            raise InputError(f"shard has an unknown array '{name}'", where=where)
        trailing = ARRAY[name].trailing
        lead = array.shape[: array.ndim - len(trailing)]
        leads.add(lead)
        if array.shape[len(lead) :] != trailing or len(lead) not in (1, 2, 3) or len(leads) > 1:
            raise InputError(f"array '{name}' has the shape {array.shape}", where=where)
    return leads.pop()


def _are_directions(omega: NDArray[np.float32]) -> NDArray[np.bool_]:
    x, y, z = (omega[..., k] for k in range(3))
    found: NDArray[np.bool_] = (np.abs(x * x + y * y + z * z - 1) <= _UNIT_TOLERANCE) & (z > 0)
    return found


# Which elements of an array are valid, and what the others are.
_VALID: dict[str, tuple[Callable[[NDArray[np.float32]], NDArray[np.bool_]], str]] = {
    "u": (lambda a: (a >= 0) & (a < 1), "numbers outside [0, 1)"),
    "sigma": (lambda a: (a > 0) & (a < np.inf), "numbers that are not positive"),
    "omega_i": (_are_directions, "vectors that are not unit vectors with z > 0"),
    "omega_o": (_are_directions, "vectors that are not unit vectors with z > 0"),
    "value_a": (np.isfinite, "NaN or infinite numbers"),
    "value_b": (np.isfinite, "NaN or infinite numbers"),
    "spp": (lambda a: (a > 0) & (a < np.inf), "numbers that are not positive"),
    "transmittance": (np.isfinite, "NaN or infinite numbers"),
    "weight": (lambda a: (a > 0) & (a < np.inf), "numbers that are not positive"),
}
# One per image of the image layout.
_SHARED = ("sigma", "omega_i", "omega_o", "weight")


def check_values(arrays: Mapping[str, NDArray[np.float32]], where: object) -> None:
    """Refuse numbers that the arrays of a shard cannot hold, with the array, the number of invalid elements,
    and the row of the first."""
    with np.errstate(all="ignore"):
        for name, array in arrays.items():
            valid, fault = _VALID[name]
            step = max(1, _CHECKED * len(array) // max(array.size, 1))
            parts = range(0, len(array), step)
            if not all(valid(array[i : i + step]).all() for i in parts):
                if not np.isfinite(array).all():
                    valid, fault = np.isfinite, "NaN or infinite numbers"
                bad = np.argwhere(~valid(array))
                what = f"'{name}' holds {fault}: {len(bad)}, the first in row {bad[0][0]}"
                raise InputError(what, where=where)
            lead = array.ndim - len(ARRAY[name].trailing)
            if name in _SHARED and lead == 3 and (array != array[:, :1, :1]).any():
                raise InputError(f"'{name}' differs between texels of an image", where=where)


def column_means(array: NDArray[np.float32]) -> NDArray[np.float64]:
    """Means (3,) of an array (..., 3), in float64."""
    flat = array.reshape(-1, 3)
    # Long rows are summed several times faster than short ones.
    head = len(flat) - len(flat) % 256
    long = flat[:head].reshape(-1, 768).sum(0, dtype=np.float64).reshape(-1, 3).sum(0)
    mean: NDArray[np.float64] = (long + flat[head:].sum(0, dtype=np.float64)) / max(len(flat), 1)
    return mean


class _Chunks(list[bytes | memoryview]):
    """A stream that collects what is written to it. It cannot seek, so that no chunk changes later."""

    def write(self, data: bytes | memoryview) -> int:
        self.append(data)
        return memoryview(data).nbytes

    def flush(self) -> None:
        pass


def _npz_chunks(arrays: Iterable[tuple[str, NDArray[np.float32]]]) -> Iterator[bytes | memoryview]:
    """The bytes of an npz archive of C-ordered arrays, in consecutive chunks, so that a digest can be
    computed while they are written."""
    chunks = _Chunks()
    position = 0
    with zipfile.ZipFile(chunks, "w") as archive:  # type: ignore[call-overload]
        for name, array in arrays:
            head = io.BytesIO()
            npy_format.write_array_header_1_0(head, npy_format.header_data_from_array_1_0(array))
            # The default date is the earliest of the format, so the bytes depend on the arrays alone.
            info = zipfile.ZipInfo(f"{name}.npy")
            info.create_system = 3
            padding = -(position + _HEADER + len(info.filename) + _SIZES_64 + 4) % _ALIGNMENT
            info.extra = b"MT" + padding.to_bytes(2, "little") + bytes(padding)
            with archive.open(info, "w", force_zip64=True) as member:
                member.write(head.getvalue())
                member.write(array.reshape(-1).view(np.uint8).data)
            position += sum(memoryview(chunk).nbytes for chunk in chunks)
            yield from chunks
            chunks.clear()
    yield from chunks


def write_npz(path: Path, arrays: Mapping[str, NDArray[np.float32]]) -> Stored:
    """Write a shard as npz, atomically; the bytes depend on the arrays alone."""
    check_arrays(arrays, path)
    present = ((s.name, np.ascontiguousarray(arrays[s.name], "<f4")) for s in ARRAYS if s.name in arrays)
    return write_chunks(path, _npz_chunks(present))


def read_npz(path: Path, names: Iterable[str] | None = None, *, mapped: bool = True) -> Arrays:
    """Arrays of an npz shard, all or those in `names`, memory-mapped read-only by default; an InputError
    where the file is missing, no shard, truncated, or compressed by another writer."""
    out: Arrays = {}
    try:
        with zipfile.ZipFile(path) as archive, path.open("rb") as stream:
            members = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            size = path.stat().st_size
            for name in members if names is None else names:
                if name not in members:
                    raise InputError(f"shard lacks the array '{name}'", where=path)
                info = members[name]
                if info.compress_type != zipfile.ZIP_STORED:
                    raise InputError("shard is compressed; shards are stored uncompressed", where=path)
                stream.seek(info.header_offset + 26)
                lengths = stream.read(4)
                skip = int.from_bytes(lengths[:2], "little") + int.from_bytes(lengths[2:], "little")
                stream.seek(info.header_offset + 30 + skip)
                start = stream.tell()
                shape, fortran, dtype = _npy_header(stream)
                if fortran or dtype != np.dtype("<f4"):
                    raise InputError(f"array '{name}' is not C-ordered float32", where=path)
                count = math.prod(shape)
                end = stream.tell() + count * dtype.itemsize
                if count < 0 or end - start != info.file_size or end > size:
                    raise InputError(f"array '{name}' is not as long as its header says", where=path)
                if mapped and 0 not in shape:
                    out[name] = np.memmap(path, dtype, mode="r", offset=stream.tell(), shape=shape)
                else:
                    out[name] = np.fromfile(stream, dtype, count).reshape(shape)
    except FileNotFoundError:
        raise InputError("no such shard", where=path) from None
    except InputError:
        raise
    except Exception as error:  # the parser of a corrupt archive or header may raise anything
        raise InputError(f"shard cannot be read ({reason(error)})", where=path) from None
    return out


def _npy_header(stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    try:
        version = npy_format.read_magic(stream)
        readers = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}
        return readers[version](stream)
    except Exception:  # the parser of a corrupt header may raise anything, including the header's bytes
        raise ValueError("the header of an array is corrupt") from None


def _fold(array: NDArray[np.float32], lead: tuple[int, ...]) -> NDArray[np.float32]:
    """Fold leading axes to (rows, columns) of one image: queries row by row, images stacked vertically, a
    slice in each row."""
    trailing = array.shape[len(lead) :]
    width = _FOLD_WIDTH if len(lead) == 1 else lead[-1]
    if len(lead) == 1:
        array = np.pad(array, [(0, -lead[0] % width), *[(0, 0)] * len(trailing)])
    return array.reshape(-1, width, *trailing)


def write_exr(path: Path, arrays: Mapping[str, NDArray[np.float32]], *, complete: bool = True) -> Stored:
    """Write a shard, of all arrays if `complete`, as one EXR image with a named float32 channel per
    component, atomically.

    The header's string ``mbtf.lead`` holds the leading axes: "n", "items,rows,columns" or
    "items,directions".
    """
    from mbtf_core.images.exr import write_channels

    lead = check_arrays(arrays, path, complete=complete)
    channels: dict[str, Any] = {}
    for spec in (a for a in ARRAYS if a.name in arrays):
        image = _fold(np.asarray(arrays[spec.name], np.float32), lead)
        for index, channel in enumerate(spec.channels):
            channels[channel] = np.ascontiguousarray(image[..., index] if spec.trailing else image)
    return write_channels(path, channels, {"mbtf.lead": ",".join(str(n) for n in lead)})


def read_exr(path: Path, names: Iterable[str] | None = None) -> Arrays:
    """Arrays of an EXR shard; an InputError where the file is missing, no EXR file, or no shard."""
    from mbtf_core.images.exr import read_parts

    if not path.exists():
        raise InputError("no such shard", where=path)
    # Shards are uncompressed: one that states more pixels than it has bytes is corrupt.
    header, stored = next(iter(read_parts(path, min(_MAX_PIXELS, path.stat().st_size)).values()))
    if "mbtf.lead" not in header:
        raise InputError("EXR image is not a shard (no 'mbtf.lead' in its header)", where=path)
    out: Arrays = {}
    try:
        lead = [int(n) for n in header["mbtf.lead"].split(",")]
        for spec in ARRAYS:
            if names is not None and spec.name not in names:
                continue
            if any(c not in stored for c in spec.channels):
                if spec.optional and names is None:
                    continue
                raise InputError(f"shard lacks the array '{spec.name}'", where=path)
            flat = np.stack([stored[c].reshape(-1)[: math.prod(lead)] for c in spec.channels], axis=-1)
            out[spec.name] = np.ascontiguousarray(flat.reshape(*lead, *spec.trailing), np.float32)
    except (ValueError, AttributeError):
        raise InputError("shard cannot be read (its 'mbtf.lead' does not fit its size)", where=path) from None
    return out


def write_shard(path: Path, arrays: Mapping[str, NDArray[np.float32]]) -> Stored:
    """Write a shard in the format that its suffix names, atomically; its size and digest."""
    return (write_exr if path.suffix == ".exr" else write_npz)(path, arrays)


def read_shard(path: Path, names: Iterable[str] | None = None, *, mapped: bool = True) -> Arrays:
    """Read a shard of either format; npz shards are memory-mapped by default.

    Raises
    ------
    InputError : missing, corrupt, or arrays with inconsistent shapes
    """
    refuse_special(path)
    wanted = None if names is None else list(names)
    arrays = read_exr(path, wanted) if path.suffix == ".exr" else read_npz(path, wanted, mapped=mapped)
    if arrays:
        check_arrays(arrays, path, complete=False)
    return arrays
