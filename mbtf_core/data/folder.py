"""The folder of a data set, local or in an object store, as its readers and writers use it.

A local folder is used in place. Of one in a store, the documents and sidecars are kept in memory as last
seen; a shard that is read is downloaded to a bounded cache. A shard that is written first goes to a local
folder, where it waits if the store cannot be reached: the next writer of the same URL uploads it.

Stores have no locks: each shard has one writer by the division of the work (``--slice``). Writers on one
machine lock the shards in the folder where they wait.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mbtf_core.data.file_cache import FileCache
from mbtf_core.data.schema import CONFIG_NAME, GEOMETRY_NAME, MANIFEST_NAME, SPLITS
from mbtf_core.data.store import LocalStore, Store, StoredFile, open_store
from mbtf_core.errors import InputError, PartialError, check_type, unwritable
from mbtf_core.files.atomic import (
    TEMPORARY,
    Stored,
    file_sha256,
    parse_checksummed,
    parse_json,
    remove_file,
    write_checksummed,
)
from mbtf_core.files.folders import cache_folder, make_folder, remove_unfinished
from mbtf_core.files.locks import lock_owner, shard_lock, take_lock

# Files that a run writes, unfinished files that a killed run leaves, and locks.
_SHARD = rf"(?:{'|'.join(SPLITS)})-\d+"
_DOCUMENTS = "|".join(re.escape(name) for name in (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME))
_SIDECAR = re.compile(rf"{_SHARD}\.json")
_OWN = re.compile(rf"{_DOCUMENTS}|{_SHARD}\.(?:npz|exr|json)")
_KEPT = re.compile(rf"{_SIDECAR.pattern}|{_DOCUMENTS}")
_UNFINISHED = re.compile(rf"\.({_OWN.pattern}){TEMPORARY}")
_LOCK = re.compile(rf"\.({_SHARD}|{re.escape(Path(MANIFEST_NAME).stem)})\.lock")
# Small files that are downloaded at once.
_THREADS = 16


def is_leftover(name: str) -> bool:
    """Whether a file is a lock, or what a killed run left unfinished."""
    return bool(_LOCK.fullmatch(name) or _UNFINISHED.fullmatch(name))


def sidecar_name(shard: str) -> str:
    """Name of the JSON file beside a shard. It is written last and marks the shard as finished."""
    return f"{shard.rpartition('.')[0]}.json"


class DataFolder:
    """The files of a data set; ``str(folder)`` is its path or URL.

    Attributes
    ----------
    store : where they are
    local : the folder, if they are on this machine; None for those of an object store
    workspace : local folder with the locks, and of a store with the shards that are not uploaded
    cache : of the shards of a store
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self.local = store.folder if isinstance(store, LocalStore) else None
        base = cache_folder() / "stores"
        key = hashlib.sha256(store.url.encode()).hexdigest()[:16]
        self.workspace = base / "waiting" / key if self.local is None else self.local
        self.cache = FileCache(base / "shards")
        # Of a store: its files as last seen, and the contents of the small ones.
        self._listed: dict[str, StoredFile] = {}
        self._contents: dict[str, bytes] = {}

    @classmethod
    def open(cls, where: str | Path | DataFolder) -> DataFolder:
        """The folder at a path or a URL, as it is now; also that of an opened data set.

        Raises
        ------
        UsageError, EngineError : `where` is something else; the package of the protocol is not installed
        InputError, PartialError : the URL is invalid, or the store refuses the request; it cannot be reached
        """
        where = getattr(where, "folder", where)
        check_type(where, (str, os.PathLike, DataFolder), "data set", "give the path or URL of its folder")
        found = where if isinstance(where, DataFolder) else cls(open_store(where))
        if found.local is None:
            make_folder(found.workspace)
        found.refresh()
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process opens it anew."""
        return DataFolder.open, (str(self),)

    def __str__(self) -> str:
        return self.store.url

    def at(self, name: str) -> str:
        """Path or URL of a file, for messages."""
        return f"{self.store.url}/{name}"

    def exists(self) -> bool:
        """Whether the folder is there; a store has no folders, so that all of its URLs are."""
        return self.local is None or self.local.is_dir()

    def refresh(self) -> None:
        """List the store, and read the documents and sidecars that have changed."""
        if self.local is not None:
            return
        before, self._listed = self._listed, self.store.list()

        def content(name: str) -> bytes | None:
            found, known = self._listed[name], before.get(name)
            # What this process has written has no tag yet.
            if found.tag and known in (found, StoredFile(found.size, "")) and name in self._contents:
                return self._contents[name]
            return self._read(name)

        documents = [name for name in self._listed if _KEPT.fullmatch(name)]
        with ThreadPoolExecutor(_THREADS) as pool:
            contents = dict(zip(documents, pool.map(content, documents), strict=True))
        self._contents = {name: found for name, found in contents.items() if found is not None}
        for name in contents.keys() - self._contents.keys():
            del self._listed[name]

    def _read(self, name: str) -> bytes | None:
        try:
            return self.store.read(name)
        except FileNotFoundError:
            return None

    def names(self) -> list[str]:
        """Names of all files and folders in order; those of folders end with "/"."""
        return sorted(self._listed if self.local is None else self.store.list())

    def sidecars(self) -> list[str]:
        """Names of all sidecars in order."""
        return [name for name in self.names() if _SIDECAR.fullmatch(name)]

    def size(self, name: str) -> int | None:
        """Size of a file in bytes; None where there is none."""
        if self.local is None:
            return self._listed[name].size if name in self._listed else None
        try:
            return (self.local / name).stat().st_size
        except OSError:
            return None

    def has(self, name: str) -> bool:
        """Whether a file is there."""
        return self.size(name) is not None

    def read(self, name: str, hint: str = "") -> bytes:
        """Content of a document or sidecar; an InputError where it cannot be read."""
        if name in self._contents:
            return self._contents[name]
        try:
            return self.store.read(name)
        except FileNotFoundError:
            raise InputError("no such file", where=self.at(name), hint=hint) from None
        except OSError as error:
            raise InputError(f"cannot be read ({error.strerror})", where=self.at(name)) from None

    def read_json(self, name: str, hint: str = "") -> dict[str, Any]:
        """A document as a JSON object; an InputError where it is none."""
        return parse_json(self.read(name, hint), self.at(name), hint)

    def read_checksummed(self, name: str, hint: str = "") -> dict[str, Any]:
        """A document without its checksum; an InputError unless it is exactly as it was written."""
        return parse_checksummed(self.read(name, hint), self.at(name), hint)

    def file(self, name: str, sha256: str, size: int | None = None) -> Path:
        """A local file with the content of a shard or geometry. One that is downloaded has been checked: an
        InputError where it is missing, or has another digest than that by sidecar or manifest. Its size is by
        default the listed one."""
        if self.local is not None:
            return self.local / name
        hint = f"check the data set with: mbtf-gen verify {self}"
        if re.fullmatch(r"[0-9a-f]{64}", sha256) is None:
            raise InputError("has no digest", where=self.at(name), hint=hint)
        size = self.size(name) or 0 if size is None else size
        try:
            return self.cache.fetch(sha256, Path(name).suffix, size, lambda: self.store.read(name))
        except FileNotFoundError:
            raise InputError("is missing", where=self.at(name), hint=hint) from None
        except InputError as error:
            raise InputError(error.what, where=self.at(name), hint=hint) from None

    @contextlib.contextmanager
    def fresh(self, name: str) -> Iterator[Path]:
        """A local file with the content that a file has now, never a cached one, for a block."""
        if self.local is not None:
            yield self.local / name
            return
        with tempfile.TemporaryDirectory(dir=self.workspace) as folder:
            path = Path(folder, name)
            content = self.store.read(name)
            try:
                path.write_bytes(content)
            except OSError as error:
                raise unwritable(path, error) from None
            yield path

    def write(self, name: str, content: bytes, *, new: bool = False) -> bool:
        """Write a document whole; False where `new`, and another writer's is there. A PartialError where the
        disk is full, or the store cannot be reached."""
        if not self.store.write(name, content, new=new):
            return False
        self._keep(name, content, len(content))
        return True

    def _keep(self, name: str, content: bytes | None, size: int) -> None:
        if self.local is None:
            self._listed[name] = StoredFile(size, "")
            if content is not None:
                self._contents[name] = content

    def delete(self, name: str) -> None:
        """Delete a file, if it is there."""
        self._contents.pop(name, None)
        if self.local is not None or self._listed.pop(name, None) is not None:
            self.store.delete(name)

    def write_shard(
        self, name: str, write: Callable[[Path], Stored], record: Callable[[Stored], dict[str, Any]]
    ) -> dict[str, Any]:
        """Write a shard by ``write(path)``, atomically, then its sidecar by ``record(size and digest)``, and
        return the sidecar. A PartialError where the disk is full, or the shard waits because the store cannot
        be reached; an InputError where it waits because the store refuses it."""
        shard, sidecar = self.workspace / name, self.workspace / sidecar_name(name)
        # If the run is killed between the two, an old sidecar would mark the new shard as finished.
        remove_file(sidecar)
        found = record(write(shard))
        write_checksummed(sidecar, found)
        if self.local is None:
            self._upload(name)
        return found

    def _upload(self, name: str) -> None:
        """Upload a shard that waits, then its sidecar, and remove both here.

        A shard of that name with a sidecar is another writer's finished one: it is kept. One without is what
        a killed writer left: it is replaced, unless it is the same.
        """
        side = sidecar_name(name)
        content, sidecar = ((self.workspace / file).read_bytes() for file in (name, side))
        # The store may have the sidecar of a shard that is lost or corrupt.
        self.delete(side)
        if not self.store.write(name, content, new=True):
            theirs = self._read(side)
            if theirs is not None:
                self._remove_waiting(name)
                self.refresh()
                return
            self.store.write(name, content)
        # Another sidecar is one of the same shard, whose seconds differ: the latest write counts.
        if not self.store.write(side, sidecar, new=True):
            self.store.write(side, sidecar)
        self._keep(name, None, len(content))
        self._keep(side, sidecar, len(sidecar))
        self._remove_waiting(name)

    def _remove_waiting(self, name: str) -> None:
        for file in (sidecar_name(name), name):
            remove_file(self.workspace / file)

    def upload_waiting(self, wanted: Callable[[dict[str, Any]], bool]) -> list[str]:
        """Upload the whole shards that earlier runs on this machine could not upload, instead of rendering
        them again, and return their names; the others are removed.

        `wanted` tells by its sidecar whether a shard belongs to the data set, which lacks it. A PartialError
        where the store cannot be reached; the shards are kept.
        """
        sent: list[str] = []
        waiting = [] if self.local is not None else list(self.workspace.iterdir())
        for path in sorted(p for p in waiting if p.suffix in (".npz", ".exr")):
            with shard_lock(path) as held:
                if not held:
                    continue
                try:
                    record = parse_checksummed((self.workspace / sidecar_name(path.name)).read_bytes(), path)
                    whole = record.get("file") == path.name and file_sha256(path) == record.get("sha256")
                except (InputError, OSError):
                    whole = False
                if whole and wanted(record):
                    self._upload(path.name)
                    sent.append(path.name)
                else:
                    self._remove_waiting(path.name)
        return sent

    def _locks(self) -> Iterator[Path]:
        """Paths from which :func:`take_lock` finds the locks."""
        for path in sorted(self.workspace.iterdir()) if self.workspace.is_dir() else ():
            if match := _LOCK.fullmatch(path.name):
                yield self.workspace / f"{match[1]}.npz"

    def remove_leftovers(self) -> None:
        """Remove the locks and unfinished files of killed runs, unless a process holds the lock."""
        general, documents = Path(MANIFEST_NAME).stem, [CONFIG_NAME, GEOMETRY_NAME]
        stems = {path.stem for path in self._locks()}
        for path in self.workspace.iterdir():
            if match := _UNFINISHED.fullmatch(path.name):
                stems.add(general if match[1] in documents else Path(match[1]).stem)
        for stem in sorted(stems):
            with shard_lock(self.workspace / f"{stem}.npz") as held:
                if held:
                    files = [f"{stem}{suffix}" for suffix in (".npz", ".exr", ".json")]
                    remove_unfinished(self.workspace, [*files, *(documents if stem == general else [])])

    def clear(self) -> None:
        """Remove the data set and nothing else, the manifest last, so that shards never remain without it. A
        PartialError where another process writes it, or a file cannot be removed."""
        with ExitStack() as held:
            for path in self._locks():
                lock = take_lock(path)
                if lock is None:
                    raise PartialError(
                        f"is being written by another process ({lock_owner(path)})",
                        where=self,
                        hint="wait for it or stop it, then run the same command again",
                    )
                held.callback(lock.release)
            files = [f for f in self.names() if any(p.fullmatch(f) for p in (_OWN, _UNFINISHED, _LOCK))]
            for file in sorted(files, key=lambda file: file == MANIFEST_NAME):
                self.delete(file)
