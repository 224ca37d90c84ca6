"""Files that are absent or complete: temporary file, fsync, rename, fsync of the folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from .errors import InputError, PartialError, reason


def sync_folder(folder: Path) -> None:
    """Make renames in `folder` durable (a no-op where folders cannot be opened)."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        with contextlib.suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise PartialError(
            f"cannot be written ({error.strerror or error})",
            where=path,
            cure="what was finished is kept; free space or mend the folder, then run the same command again",
        ) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_file(path: Path, write: Callable[[BinaryIO], None]) -> None:
    """Write `path` through `write(stream)` so that a crash at any instant leaves the old file or the new one.

    Raises
    ------
    PartialError : the disk is full or the folder cannot be written
    """
    with _replacing(path) as temporary, temporary.open("wb") as stream:
        write(stream)
        stream.flush()
        os.fsync(stream.fileno())


def write_through(path: Path, write: Callable[[Path], None]) -> None:
    """Like :func:`write_file` for libraries that want a file name: `write(temporary)` creates it."""
    with _replacing(path) as temporary:
        write(temporary)
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())


def _put(stream: BinaryIO, text: str) -> None:
    stream.write(text.encode())


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write plain data as indented JSON, atomically. NaN and infinities are refused."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    write_file(path, lambda stream: _put(stream, text))


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, atomically."""
    write_file(path, lambda stream: _put(stream, text))


def read_json(path: Path) -> dict[str, Any]:
    """JSON object stored in a file.

    Raises
    ------
    InputError : missing, unreadable, or not a JSON object
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise InputError("no such file", where=path) from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"not readable as JSON ({reason(error)})", where=path) from None
    if not isinstance(data, dict):
        raise InputError("must hold a JSON object", where=path)
    return data


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no number of JSON")


def digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal (what ``sha256sum`` prints)."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
