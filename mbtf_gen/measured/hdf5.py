"""Checked access to the data sets of untrusted HDF5 files."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError, MbtfError, reason
from mbtf_core.paths import refuse_special, suggest_path

MAGIC = b"\x89HDF\r\n\x1a\n"
# Largest chunk, which is the least that the library decompresses at a time.
_MOST_CHUNK_BYTES = 1 << 28


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The h5py file of a path; whatever the library raises within becomes an InputError.

    Raises
    ------
    InputError
        The file is missing, is not HDF5, is truncated or damaged.
    """
    import h5py

    refuse_special(path)
    if not path.is_file():
        raise InputError("no such file", where=path, hint=suggest_path(path))
    try:
        with h5py.File(path, "r") as file:
            yield file
    except MbtfError:
        raise
    except Exception as error:  # a damaged file may make the library raise anything
        raise InputError(
            f"cannot be read as HDF5 ({reason(error)})", where=path, hint="check that the file is complete"
        ) from None


def names_of(file: Any) -> set[str]:
    """Names in the root of a file."""
    return set(file.keys())


def data_set(file: Any, name: str, path: Path) -> Any:
    """A data set of floats in the root of a file, with every number stored in this file.

    Raises
    ------
    InputError
        It is missing, leads to another file, has no floats, or has parts that were never written.
    """
    import h5py

    link = file.get(name, getlink=True)
    if link is None:
        found = ", ".join(sorted(names_of(file))[:10])
        raise InputError(
            f"has no data set '{name}'", where=path, hint=f"it has {found}" if found else "it is empty"
        )
    if not isinstance(link, h5py.HardLink):
        raise InputError(f"has a link in place of the data set '{name}'", where=path)
    found = file[name]
    if not isinstance(found, h5py.Dataset):
        raise InputError(f"has a group in place of the data set '{name}'", where=path)
    if found.is_virtual or found.external:
        raise InputError(f"keeps the data set '{name}' in other files", where=path)
    if found.dtype.kind != "f" or found.dtype.itemsize not in (2, 4, 8):
        raise InputError(f"has {found.dtype} numbers in '{name}'; floats are expected", where=path)
    if found.shape is None or not found.shape or min(found.shape) < 1:
        raise InputError(f"has the shape {found.shape} of '{name}'", where=path)
    if found.compression not in (None, "gzip", "lzf"):
        raise InputError(f"has '{name}' compressed by '{found.compression}'", where=path)
    _check_stored(found, name, path)
    return found


def _check_stored(found: Any, name: str, path: Path) -> None:
    size = math.prod(found.shape) * found.dtype.itemsize
    if found.chunks is None:
        stored = found.id.get_storage_size()
        if stored != size:
            raise InputError(f"stores {stored:,} of the {size:,} bytes of '{name}'", where=path)
        if stored > path.stat().st_size:
            raise InputError(f"is too short for the {size:,} bytes of '{name}'", where=path)
        return
    if math.prod(found.chunks) * found.dtype.itemsize > _MOST_CHUNK_BYTES:
        raise InputError(f"has chunks {found.chunks} of '{name}', which are too large", where=path)
    chunks = math.prod(-(-n // c) for n, c in zip(found.shape, found.chunks, strict=True))
    stored = found.id.get_num_chunks()
    if stored != chunks:
        raise InputError(f"stores {stored:,} of the {chunks:,} chunks of '{name}'", where=path)


def floats(found: Any, start: int, stop: int) -> NDArray[np.float64]:
    """Numbers of the first axis from `start` to before `stop`; those beyond the range become infinite."""
    with np.errstate(invalid="ignore"):
        return np.asarray(found[start:stop]).astype(np.float64)
