"""Files that are absent or complete (temporary file, fsync, rename, fsync of the folder); digests."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import socket
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from mbtf_core.errors import InputError, reason, unwritable
from mbtf_core.paths import refuse_special

_CHECKSUM = "checksum"

# Errors of folders that cannot be opened or synced at all; others mean that the disk failed.
_NO_FOLDER_SYNC = (errno.EACCES, errno.EPERM, errno.EISDIR, errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)
# Errors of file systems without hard links.
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)

Buffer = bytes | bytearray | memoryview


@dataclass(frozen=True)
class Stored:
    """Size of a file in bytes, and its SHA-256 in hexadecimal."""

    bytes: int
    sha256: str


def sync_folder(folder: Path) -> None:
    """Make renames in `folder` durable (a no-op where folders cannot be opened or synced); an OSError where
    the disk failed."""
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise


def temporary_of(path: Path) -> Path:
    """Name of the unfinished file of `path` that this process writes: its machine and its number make it
    unique among all writers of a folder."""
    machine = zlib.crc32(socket.gethostname().encode())
    return path.with_name(f".{path.name}.{machine:08x}-{os.getpid()}.tmp")


# The names that `temporary_of` gives, after the dot and the file's own name.
TEMPORARY = r"\.[0-9a-f]{8}-\d+\.tmp"


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A fresh name to write to; an error of the system becomes a PartialError."""
    temporary = temporary_of(path)
    try:
        # A killed process of the same number may have left it.
        temporary.unlink(missing_ok=True)
        yield temporary
    except OSError as error:
        raise unwritable(path, error) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _replace(temporary: Path, path: Path) -> None:
    os.replace(temporary, path)
    sync_folder(path.parent)


def write_file(path: Path, write: Callable[[BinaryIO], None]) -> None:
    """Write `path` through `write(stream)` so that a crash at any instant leaves the old file or the new one;
    a PartialError where the disk is full or the folder cannot be written."""
    with _temporary(path) as temporary:
        _fill(temporary, write)
        _replace(temporary, path)


def _fill(temporary: Path, write: Callable[[BinaryIO], object]) -> None:
    with temporary.open("wb") as stream:
        write(stream)
        stream.flush()
        os.fsync(stream.fileno())


def write_chunks(path: Path, chunks: Iterable[Buffer]) -> Stored:
    """Write `path` from consecutive pieces, atomically, and digest it on the way; errors are those of
    :func:`write_file`."""
    sha, size = hashlib.sha256(), 0

    def write(stream: BinaryIO) -> None:
        nonlocal size
        for chunk in chunks:
            stream.write(chunk)
            sha.update(chunk)
            size += memoryview(chunk).nbytes

    write_file(path, write)
    return Stored(size, sha.hexdigest())


def write_through(path: Path, write: Callable[[Path], None]) -> Stored:
    """Like :func:`write_chunks` for libraries that need a file name: `write(temporary)` creates it."""
    with _temporary(path) as temporary:
        try:
            write(temporary)
        except RuntimeError as error:
            # OpenEXR's, which ends with the file's name and the system's error.
            raise OSError(errno.EIO, reason(str(error).rpartition('". ')[2].rstrip("."))) from None
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())
        stored = Stored(temporary.stat().st_size, file_sha256(temporary))
        _replace(temporary, path)
    return stored


def create_file(path: Path, content: bytes) -> bool:
    """Write a file unless it exists; False where it does. Errors are those of :func:`write_file`.

    One of several writers succeeds, also across machines: a hard link names the file. On file systems without
    hard links there is a short window in which the last writer succeeds.
    """
    with _temporary(path) as temporary:
        _fill(temporary, lambda stream: stream.write(content))
        try:
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
            if path.exists():
                return False
            os.replace(temporary, path)
        sync_folder(path.parent)
    return True


def remove_file(path: Path) -> None:
    """Remove a file for good, if it is there; a PartialError where the folder cannot be written."""
    try:
        path.unlink()
        sync_folder(path.parent)
    except FileNotFoundError:
        return
    except OSError as error:
        raise unwritable(path, error) from None


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write plain data as indented JSON, atomically. NaN and infinities are refused."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, atomically."""
    write_chunks(path, [text.encode()])


def checksummed(data: Mapping[str, Any]) -> bytes:
    """`data` as indented JSON whose last key, ``checksum``, is the SHA-256 of the text itself with the 64
    digits of that key set to 0. NaN and infinities are refused."""
    zeros = "0" * 64
    document = {**{k: v for k, v in data.items() if k != _CHECKSUM}, _CHECKSUM: zeros}
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    head, _, tail = text.rpartition(zeros)
    return f"{head}{hashlib.sha256(text.encode()).hexdigest()}{tail}".encode()


def write_checksummed(path: Path, data: Mapping[str, Any]) -> None:
    """Write :func:`checksummed` data, atomically."""
    write_chunks(path, [checksummed(data)])


def parse_checksummed(content: bytes, where: object, hint: str = "") -> dict[str, Any]:
    """JSON object of a checksummed document, its checksum left out; an InputError, with its name `where` and
    a hint, unless it is a JSON object exactly as it was written."""
    data = parse_json(content, where, hint)
    try:
        unchanged = checksummed(data) == content
    except (ValueError, RecursionError):  # a number beyond float64; nested too deeply
        unchanged = False
    if not unchanged:
        raise InputError("has changed since it was written (its checksum differs)", where=where, hint=hint)
    del data[_CHECKSUM]
    return data


def parse_json(content: bytes, where: object, hint: str = "") -> dict[str, Any]:
    """A JSON object; an InputError, with its name `where` and a hint, where it is none."""
    try:
        data = json.loads(content.decode(), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"not readable as JSON ({reason(error)})", where=where, hint=hint) from None
    if not isinstance(data, dict):
        raise InputError("must hold a JSON object", where=where, hint=hint)
    return data


def read_json(path: Path, hint: str = "") -> dict[str, Any]:
    """JSON object stored in a file; an InputError where it is missing, unreadable or, with the hint,
    damaged."""
    refuse_special(path)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise InputError("no such file", where=path, hint=hint) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    return parse_json(content, path, hint)


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")


def file_sha256(path: Path) -> str:
    """SHA-256 of a regular file, in hexadecimal (what ``sha256sum`` prints)."""
    refuse_special(path)
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def data_sha256(data: Any) -> str:
    """SHA-256 of plain data as canonical JSON, in hexadecimal: the order of keys does not count."""
    return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
