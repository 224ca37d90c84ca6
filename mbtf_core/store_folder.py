"""Data sets in object stores: a folder of a store that the programs use like a local one.

Documents and sidecars are copied to a working folder of the process. Shards stay in the store: reading one
downloads it to a bounded cache; writing makes local files, which are uploaded and removed. The working folder
of a process that was killed keeps the shards that were not uploaded; the next writer of the same URL finds
them. :mod:`mbtf_core.data_folder` has what other modules call.

Stores have no locks: each shard has one writer by the division of the work (``--slice``).
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import fnmatch
import hashlib
import json
import os
import queue
import re
import shutil
import stat
import tempfile
import threading
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import ClassVar

from mbtf_core.atomic import unwritable
from mbtf_core.errors import InputError, MbtfError
from mbtf_core.file_cache import FileCache
from mbtf_core.folders import cache_folder, make_folder
from mbtf_core.run import signals
from mbtf_core.shard_schema import CONFIG_NAME, GEOMETRY_NAME, MANIFEST_NAME, SPLITS
from mbtf_core.store import Store, StoredObject

_SPLIT = rf"(?:{'|'.join(SPLITS)})-\d+"
_SHARD = re.compile(rf"{_SPLIT}\.(?:npz|exr)")
_DOCUMENTS = "|".join(map(re.escape, (MANIFEST_NAME, CONFIG_NAME, GEOMETRY_NAME)))
_COPIED = re.compile(rf"{_SPLIT}\.json|{_DOCUMENTS}")
# Small files, and shards to be read next, that are downloaded at once; shards that must fit into a cache for
# others to be downloaded ahead.
_THREADS, _AHEAD, _ROOM = 16, 2, 16
_OWNER, _FILES = "owner.lock", "files"


class StorePath(type(Path())):  # type: ignore[misc]
    """A file or folder of a data set in a store. Messages show its URL; programs use the working copy.

    Shards exist where the store lists them, with the store's size, although their bytes are elsewhere: see
    :meth:`StoreFolder.local`. One that is not uploaded yet does not exist. Removing a file also deletes it in
    the store.
    """

    def __fspath__(self) -> str:
        return str(super().__str__())

    def __str__(self) -> str:
        folder = self.folder
        if folder is None:
            return self.__fspath__()
        return folder.url if self.__fspath__() == folder.root else f"{folder.url}/{self.name}"

    @property
    def folder(self) -> StoreFolder | None:
        """The folder of the store; None once it is closed."""
        there = self.__fspath__()
        return StoreFolder.by_root.get(there) or StoreFolder.by_root.get(os.path.dirname(there))

    @property
    def _listed(self) -> StoredObject | None:
        folder = self.folder
        return None if folder is None else folder.listed.get(self.name)

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        if self.folder is not None and _SHARD.fullmatch(self.name):
            return self._listed is not None
        return os.path.exists(self.__fspath__()) or self._listed is not None

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        listed = self._listed
        if listed is not None and (_SHARD.fullmatch(self.name) or not os.path.exists(self.__fspath__())):
            return os.stat_result((stat.S_IFREG | 0o444, 0, 0, 1, 0, 0, listed.size, 0, 0, 0))
        return os.stat(self.__fspath__(), follow_symlinks=follow_symlinks)

    def iterdir(self) -> Generator[StorePath]:
        folder = self.folder
        listed = set() if folder is None else {name.rstrip("/") for name in folder.listed}
        for name in sorted(listed | set(os.listdir(self.__fspath__()))):
            yield self / name

    def glob(self, pattern: str) -> Iterator[StorePath]:
        return (path for path in self.iterdir() if fnmatch.fnmatchcase(path.name, pattern))

    def unlink(self, missing_ok: bool = False) -> None:
        folder, there = self.folder, os.path.exists(self.__fspath__())
        if folder is not None and self.name in folder.listed:
            folder.delete(self.name)
        elif not there and not missing_ok:
            raise FileNotFoundError(2, "No such file", str(self))
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.__fspath__())


class StoreFolder:
    """The working copy of a store's folder; one per URL and process.

    Attributes
    ----------
    url : of the folder
    root : path of the working folder
    listed : objects of the store by name, as last seen
    cache : of shards
    """

    by_root: ClassVar[dict[str, StoreFolder]] = {}
    _by_url: ClassVar[dict[str, StoreFolder]] = {}
    _guard: ClassVar[threading.RLock] = threading.RLock()

    def __init__(self, url: str) -> None:
        self.url = url
        self.store = Store(url)
        self.listed: dict[str, StoredObject] = {}
        base = cache_folder() / "stores"
        self.cache = FileCache(base / "shards")
        self._works = base / "work"
        self._key = hashlib.sha256(url.encode()).hexdigest()[:16]
        make_folder(self._works)
        try:
            self._home, self._owner = self._new_home()
            self.root = os.path.join(self._home, _FILES)
            os.mkdir(self.root)
        except OSError as error:
            raise unwritable(self._works, error) from None
        for home, handle in self._ended():
            # Shards that wait there are left to the next writer of their URL.
            if not _shards(home / _FILES):
                shutil.rmtree(home, ignore_errors=True)
            os.close(handle)
        # Tags of the files as they were copied, or as they were uploaded.
        self._tags: dict[str, str] = {}
        # Names of the shards in order, their numbers, and the one that was read last.
        self._shards: list[str] = []
        self._order: dict[str, int] = {}
        self._last = ""
        self._wanted: queue.Queue[str] = queue.Queue()
        self._readers: list[threading.Thread] = []

    @classmethod
    def open(cls, url: str) -> StoreFolder:
        """The working copy of a URL, as the store is now."""
        with cls._guard:
            found = cls._by_url.get(url)
            if found is None:
                found = cls(url)
                cls._by_url[url] = cls.by_root[found.root] = found
        found.refresh()
        return found

    @property
    def path(self) -> Path:
        """The folder as programs use it."""
        path: Path = StorePath(self.root)
        return path

    def refresh(self) -> None:
        """List the store, copy the documents and sidecars that have changed, drop those that are gone."""
        with self._guard:
            self.listed = self.store.list()
            changed = [
                name
                for name, found in self.listed.items()
                if _COPIED.fullmatch(name)
                and not (found.tag and self._tags.get(name) == found.tag and self._at(name).exists())
            ]
            with ThreadPoolExecutor(_THREADS) as pool:
                for name, content in zip(changed, pool.map(self._read, changed), strict=True):
                    if content is None:
                        del self.listed[name]
                        continue
                    self._keep(name, content)
            self._shards = sorted(name for name in self.listed if _SHARD.fullmatch(name))
            self._order = {name: at for at, name in enumerate(self._shards)}
            for name in [name for name in self._tags if name not in self.listed]:
                del self._tags[name]
                self._at(name).unlink(missing_ok=True)

    def _at(self, name: str) -> Path:
        return Path(self.root, name)

    def _is_here(self, name: str) -> bool:
        """Whether the working folder has what the store lists. Its shards are those that are not uploaded."""
        return name not in self.listed or (self._at(name).exists() and not _SHARD.fullmatch(name))

    def _read(self, name: str) -> bytes | None:
        try:
            return self.store.read(name)
        except FileNotFoundError:
            return None

    def _keep(self, name: str, content: bytes) -> None:
        part = self._at(f".{name}.part")
        try:
            part.write_bytes(content)
            os.replace(part, self._at(name))
        except OSError as error:
            raise unwritable(part, error) from None
        self._tags[name] = self.listed[name].tag

    def delete(self, name: str) -> None:
        """Delete an object of the store."""
        self.store.delete(name)
        self.listed.pop(name, None)
        self._tags.pop(name, None)

    def send(self, name: str, *, new: bool = False) -> bool:
        """Upload a file; False where `new`, and the store has another one of that name."""
        content = self._at(name).read_bytes()
        if not self.store.write(name, content, new=new):
            return False
        try:
            found = self.store.info(name)
        except FileNotFoundError:
            found = StoredObject(len(content), "")
        self.listed[name] = found
        self._tags[name] = found.tag
        return True

    def send_shard(self, shard: str, sidecar: str) -> None:
        """Upload a shard, then its sidecar, and remove the local shard.

        A shard of that name with a sidecar is another writer's finished one: it is kept. One without is what
        a killed writer left: it is replaced, unless it is the same.
        """
        if not self.send(shard, new=True):
            theirs = self._read(sidecar)
            if theirs is not None:
                found = self.store.info(shard)
                self.listed |= {shard: found, sidecar: self.store.info(sidecar)}
                self._keep(sidecar, theirs)
                self._at(shard).unlink(missing_ok=True)
                return
            self.send(shard)
        # Another sidecar is one of the same shard, whose seconds differ: the latest write counts.
        if not self.send(sidecar, new=True):
            self.send(sidecar)
        self._at(shard).unlink(missing_ok=True)

    def local(self, name: str) -> Path:
        """A local copy of a file, whose digest has been checked; the next ones are read ahead where shards
        are read in order.

        Raises
        ------
        InputError : the shard has no readable sidecar, or is not the one that it describes
        PartialError : the store cannot be reached, or the disk is full
        """
        if self._is_here(name):
            return self._at(name)
        path = self._fetch(name)
        at = self._order.get(name, 0)
        # Random access announces its shards itself.
        if self._order.get(self._last, -1) in (-1, at - 1):
            for following in self._shards[at + 1 : at + 1 + _AHEAD]:
                self.prefetch(following)
        self._last = name
        return path

    def _fetch(self, name: str) -> Path:
        where = f"{self.url}/{name}"
        hint = f"check the data set with: mbtf-gen verify {self.url}"
        try:
            record = json.loads(self._at(name).with_suffix(".json").read_bytes())
            sha256, size = str(record["sha256"]), int(record["bytes"])
            if re.fullmatch(r"[0-9a-f]{64}", sha256) is None:
                raise ValueError
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError("has no readable sidecar", where=where, hint=hint) from None
        try:
            return self.cache.fetch(
                sha256, Path(name).suffix, size, lambda path: self.store.download(name, path)
            )
        except FileNotFoundError:
            raise InputError("is missing", where=where, hint=hint) from None
        except InputError as error:
            raise InputError(error.what, where=where, hint=hint) from None

    def prefetch(self, name: str) -> None:
        """Download a shard in a background thread; failures are left to the reader. A cache of a few shards
        has no room for it."""
        listed = self.listed.get(name)
        if listed is None or _ROOM * listed.size > self.cache.limit:
            return
        with self._guard:
            while len(self._readers) < _AHEAD:
                # As a daemon it does not delay the exit.
                self._readers.append(threading.Thread(target=self._read_ahead, name="prefetch", daemon=True))
                self._readers[-1].start()
        if name not in self._wanted.queue:
            self._wanted.put(name)

    def _read_ahead(self) -> None:
        while True:
            name = self._wanted.get()
            with contextlib.suppress(MbtfError):
                self._fetch(name)

    @contextlib.contextmanager
    def fresh(self, name: str) -> Iterator[Path]:
        """A file as the store has it now, for a block."""
        if self._is_here(name):
            yield self._at(name)
            return
        with tempfile.TemporaryDirectory(dir=self._home) as folder:
            path = Path(folder, name)
            self.store.download(name, path)
            yield path

    def _new_home(self) -> tuple[str, int | None]:
        """A working folder and the handle of its lock; it gets its name once it is locked."""
        made = tempfile.mkdtemp(prefix=".", dir=self._works)
        handle = _owned(Path(made))
        home = os.path.join(self._works, f"{self._key}-{os.path.basename(made)[1:]}")
        os.rename(made, home)
        return home, handle

    def _ended(self) -> Iterator[tuple[Path, int]]:
        """(working folder, handle of its lock) of ended processes, of all URLs."""
        for home in sorted(self._works.iterdir()):
            if home.name.startswith("."):
                continue
            with contextlib.suppress(OSError):
                if (handle := _owned(home)) is not None:
                    yield home, handle

    @contextlib.contextmanager
    def abandoned(self) -> Iterator[list[Path]]:
        """Files of ended processes of this URL, with the shards that these could not upload. They are removed
        after the block, unless it fails."""
        with contextlib.ExitStack() as stack:
            found: list[Path] = []
            for home, handle in self._ended():
                stack.callback(os.close, handle)
                if home.name.startswith(f"{self._key}-"):
                    found.append(home / _FILES)
            yield found
            for folder in found:
                shutil.rmtree(folder.parent, ignore_errors=True)

    def waiting(self) -> list[str]:
        """Shards that are not uploaded yet."""
        return [path.name for path in _shards(Path(self.root)) if path.with_suffix(".json").exists()]

    def close(self) -> None:
        """Remove the working folder, unless shards wait in it."""
        if not self.waiting():
            shutil.rmtree(self._home, ignore_errors=True)
        with contextlib.suppress(OSError):
            if self._owner is not None:
                os.close(self._owner)


def _shards(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if _SHARD.fullmatch(path.name))
    except OSError:
        return []


def _owned(home: Path) -> int | None:
    """Handle of the lock of a working folder, which ends with the process; None if another owns it."""
    handle = os.open(home / _OWNER, os.O_CREAT | os.O_RDWR, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        return None
    return handle


@atexit.register
def close_stores() -> None:
    """Remove the working folders of this process."""
    for folder in list(StoreFolder.by_root.values()):
        folder.close()
    StoreFolder.by_root.clear()
    StoreFolder._by_url.clear()


signals.at_end(close_stores)
