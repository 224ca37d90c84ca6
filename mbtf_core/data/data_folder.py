"""Folders of data sets, local or in object stores: what reads and writes them calls these functions.

All but :func:`data_folder` do nothing, or return their argument, where the folder is local.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

from mbtf_core.data.store_folder import StoreFolder, StorePath
from mbtf_core.errors import InputError
from mbtf_core.urls import split_url

T = TypeVar("T")
# Times that a shard is downloaded again because it has left the cache.
_READS = 8


def data_folder(folder: str | Path) -> Path:
    """The folder of a data set, local or in a store.

    Parameters
    ----------
    folder : str or Path
        A path, or a URL such as ``s3://bucket/data``. ``file://`` is a local path.

    Returns
    -------
    Path
        For a URL, its :class:`StorePath`, with the documents as the store has them now.

    Raises
    ------
    EngineError
        The package of the protocol is not installed.
    InputError
        The URL is invalid, or the store refuses the request.
    PartialError
        The store cannot be reached.
    """
    if isinstance(folder, StorePath):
        if (found := folder.folder) is not None:
            found.refresh()
        return folder
    url = split_url(folder)
    if url is None:
        return Path(folder)
    protocol, rest = url
    if protocol in ("file", "local"):
        return Path(unquote(f"/{rest}"))
    if not rest.strip("/"):
        raise InputError("names no bucket", where=folder, hint="such as s3://bucket/data")
    return StoreFolder.open(f"{protocol}://{rest}").path


def in_store(path: Path) -> bool:
    """Whether a path is one of a store."""
    return isinstance(path, StorePath)


def _parts(path: Any) -> tuple[StoreFolder, str] | None:
    folder = path.folder if isinstance(path, StorePath) else None
    return None if folder is None else (folder, path.name)


def local_copy(path: Path) -> Path:
    """A local file with the content of `path`: itself, or the cached copy of a shard in a store.

    Raises
    ------
    InputError : the shard is missing, or not the one that its sidecar describes
    PartialError : the store cannot be reached, or the disk is full
    """
    parts = _parts(path)
    return path if parts is None else parts[0].local(parts[1])


def read_local(path: Path, read: Callable[[Path], T]) -> T:
    """Result of a function of a :func:`local_copy`. It is made again if other readers make room in the cache
    before the function opens it. Errors name `path`.

    Raises
    ------
    the errors of :func:`local_copy` and of `read`
    """
    for last in (*[False] * _READS, True):
        file = local_copy(path)
        try:
            return read(file)
        except InputError as error:
            if last or file is path or file.exists() or not path.exists():
                raise InputError(error.what, where=path, hint=error.hint) from None
    raise AssertionError


@contextlib.contextmanager
def fresh_copy(path: Path) -> Iterator[Path]:
    """A local file with the content of `path` as it is now, never a cached one, for a block."""
    parts = _parts(path)
    if parts is None:
        yield path
        return
    with parts[0].fresh(parts[1]) as found:
        yield found


def prefetch(path: Path) -> None:
    """Start to download a shard in a store; a no-op for local files."""
    parts = _parts(path)
    if parts is not None:
        parts[0].prefetch(parts[1])


def send(path: Path, *, new: bool = False) -> bool:
    """Upload a written file of a data set in a store; a no-op for local files.

    Parameters
    ----------
    new : do not replace a file of the store

    Returns
    -------
    bool
        False where `new`, and another writer has stored another file of that name.
    """
    parts = _parts(path)
    return True if parts is None else parts[0].send(parts[1], new=new)


def send_shard(shard: Path, sidecar: Path) -> None:
    """Upload a written shard, then its sidecar, and remove the local shard; a no-op for local files."""
    parts = _parts(shard)
    if parts is not None:
        parts[0].send_shard(parts[1], sidecar.name)


def limit_cache(folder: Path, limit: float) -> None:
    """Bound the cache of a data set in a store, in bytes."""
    parts = _parts(folder)
    if parts is not None:
        parts[0].cache.limit = limit


def waiting_shards(folder: Path) -> list[Path]:
    """Shards of a data set in a store that this process has written and could not upload; none of a local
    one."""
    parts = _parts(folder)
    return [] if parts is None else [folder / name for name in parts[0].waiting()]


@contextlib.contextmanager
def abandoned(folder: Path) -> Iterator[list[Path]]:
    """Local folders with shards that ended processes could not upload to a data set's store, for a block that
    uses them; they are removed after it. None for a local data set."""
    parts = _parts(folder)
    if parts is None:
        yield []
        return
    with parts[0].abandoned() as found:
        yield found
