"""Where the files of a data set lie: a local folder, or a folder of an object store through fsspec.

A store lists, reads, writes once and deletes. Files are written whole: a store shows a file only once all of
it has arrived.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar
from urllib.parse import unquote

from mbtf_core.errors import EngineError, InputError, PartialError, UsageError, reason
from mbtf_core.extras import extra_error, import_extra
from mbtf_core.files.atomic import create_file, remove_file, write_chunks
from mbtf_core.paths import refuse_special, split_url
from mbtf_core.run.timeouts import NoAnswer, call_within

log = logging.getLogger(__name__)
T = TypeVar("T")

# Seconds in which a request must be answered, and from its start to its last attempt; the environment
# variable overrides them.
PATIENCE_VARIABLE, PATIENCE_SECONDS = "MBTF_STORE_PATIENCE", 30.0
# An answer may take a second at least. So many bytes may take as long again.
_LEAST_SECONDS, _BLOCK_BYTES = 1.0, 8 << 20
# First pause between two attempts, and the longest one; each is twice as long as the one before.
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 10.0
# Packages of protocols that the extra `stores` leaves out.
_PACKAGES = {"gs": "gcsfs", "gcs": "gcsfs", "abfs": "adlfs", "az": "adlfs"}
# Errors of a request that another attempt does not help: classes, also of optional packages, by name; codes
# of answers, those of HTTP in errors of gcsfs, and of S3 where s3fs has no class for them.
_REFUSED = {
    *("PermissionError", "NotImplementedError", "TypeError", "ValueError"),
    *("IsADirectoryError", "NotADirectoryError", "NoCredentialsError", "PartialCredentialsError"),
    *("ProfileNotFound", "DefaultCredentialsError", "ParamValidationError"),
}
_REFUSED_CODES = {
    *(401, 403, "AuthorizationHeaderMalformed", "InvalidBucketName", "InvalidToken"),
    *("KeyTooLongError", "MethodNotAllowed", "PermanentRedirect"),
}
# Answers of S3 to a conditional write: there is such an object, and this store has no such writes. s3fs knows
# the first one only where the answer names the condition, as that of Amazon does.
_EXISTS, _UNCONDITIONAL = ("PreconditionFailed", "412"), ("NotImplemented", "501")


@dataclass(frozen=True)
class StoredFile:
    """A file of a store: size in bytes, and a text that changes with its content (empty: unknown)."""

    size: int
    tag: str


class Store(Protocol):
    """A folder of files, by name; `url` is its path or URL, for messages."""

    url: str

    def list(self) -> dict[str, StoredFile]:
        """All files and folders, without those in sub-folders; names of folders end with "/"."""

    def read(self, name: str) -> bytes:
        """Content of a file; a FileNotFoundError where there is none."""

    def write(self, name: str, content: bytes, *, new: bool = False) -> bool:
        """Write a file whole; False where `new`, and another file has that name."""

    def delete(self, name: str) -> None:
        """Delete a file, if it is there."""


class LocalStore:
    """A local folder, which may be missing; see :class:`Store`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.url = str(folder)

    def list(self) -> dict[str, StoredFile]:
        """All files and folders; names of folders end with "/"."""
        found = {}
        with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(self.folder) as entries:
            for entry in entries:
                # Other processes remove their locks and unfinished files.
                with contextlib.suppress(FileNotFoundError):
                    found[entry.name + "/" * entry.is_dir()] = StoredFile(entry.stat().st_size, "")
        return found

    def read(self, name: str) -> bytes:
        """Content of a regular file."""
        refuse_special(self.folder / name)
        return (self.folder / name).read_bytes()

    def write(self, name: str, content: bytes, *, new: bool = False) -> bool:
        """Write a file atomically; False where `new`, and there is one."""
        if new:
            return create_file(self.folder / name, content)
        write_chunks(self.folder / name, [content])
        return True

    def delete(self, name: str) -> None:
        """Delete a file for good, if it is there."""
        remove_file(self.folder / name)


class ObjectStore:
    """The objects of one folder of an object store, such as ``s3://bucket/data``; see :class:`Store`. fsspec
    reads credentials and endpoint from the environment. A request whose connection drops is tried again with
    growing pauses until the patience ends. One that is not answered is given up.

    Raises
    ------
    EngineError : the package of the protocol is not installed
    InputError, PartialError : the URL is invalid; the store does not answer
    """

    def __init__(self, url: str) -> None:
        self.url = url
        try:
            self.patience = float(os.environ.get(PATIENCE_VARIABLE) or PATIENCE_SECONDS)
        except ValueError:
            raise UsageError("must be a number of seconds", where=PATIENCE_VARIABLE) from None
        # Set once the patience has ended: requests of other threads do not wait for it again.
        self._lost = threading.Event()
        # Bytes of objects, as last listed.
        self._sizes: dict[str, int] = {}
        fsspec = import_extra("fsspec", url)
        protocol = url.partition("://")[0]
        try:
            # Some protocols connect at once.
            self._files, root = self._answer(
                url, self._seconds(), lambda: fsspec.url_to_fs(url, use_listings_cache=False)
            )
        except ImportError as error:
            if protocol in ("s3", "s3a"):
                raise extra_error("s3fs", url) from None
            package = _PACKAGES.get(protocol)
            hint = f"pip install {package}" if package else "install it with pip"
            raise EngineError(f"a package is not installed ({reason(error)})", where=url, hint=hint) from None
        except ValueError as error:
            raise InputError(f"cannot be opened ({reason(error)})", where=url) from None
        self._root = str(root).rstrip("/")
        _quiet(self._files)

    def _at(self, name: str) -> str:
        return f"{self._root}/{name}"

    def _seconds(self, size: int = 0) -> float:
        """Seconds after which a request that moves so many bytes is given up."""
        patience = _LEAST_SECONDS if self._lost.is_set() else max(self.patience, _LEAST_SECONDS)
        return patience * (1 + size / _BLOCK_BYTES)

    def _answer(self, where: str, seconds: float, function: Callable[[], T]) -> T:
        """Result of one attempt; a PartialError where it is not answered in time."""
        try:
            return call_within(seconds, function)
        except NoAnswer as error:
            self._lost.set()
            raise PartialError(
                f"the store does not answer ({reason(error)})",
                where=where,
                hint=f"check the endpoint and the network, or wait longer: {PATIENCE_VARIABLE}=300",
            ) from None

    def _request(self, name: str, function: Callable[[], T], size: int = 0) -> T:
        """Result of a request for an object (the folder: empty) that moves so many bytes, tried again where
        the connection fails. A FileNotFoundError or FileExistsError as the store says, an InputError where it
        refuses the request, a PartialError where it cannot be reached."""
        where = f"{self.url}/{name}" if name else self.url
        pause, give_up = _FIRST_PAUSE, time.monotonic() + self.patience * (1 + size / _BLOCK_BYTES)
        failed: Exception | None = None
        while True:
            # Libraries try again by themselves: all attempts together have the time of one.
            left = self._seconds(size) if failed is None else give_up - time.monotonic()
            try:
                result = self._answer(where, max(left, _LEAST_SECONDS), function)
                self._lost.clear()
                return result
            except (FileNotFoundError, FileExistsError):
                # The store has answered.
                self._lost.clear()
                raise
            except PartialError:
                if failed is not None:
                    raise self._unreachable(where, failed) from None
                raise
            except Exception as error:
                failed = error
                if _is_refusal(error):
                    raise InputError(
                        f"the store refuses it ({reason(error)})",
                        where=where,
                        hint="check the credentials, the endpoint and the name of the bucket",
                    ) from None
                log.debug("%s: %s", where, reason(error))
                if self._lost.is_set() or time.monotonic() + pause > give_up:
                    self._lost.set()
                    raise self._unreachable(where, error) from None
                time.sleep(pause)
                pause = min(2.0 * pause, _LONGEST_PAUSE)

    @staticmethod
    def _unreachable(where: str, error: Exception) -> PartialError:
        return PartialError(
            f"the store cannot be reached ({reason(error)})",
            where=where,
            hint="what is finished is kept; run the same command again, "
            f"or wait longer: {PATIENCE_VARIABLE}=300",
        )

    def list(self) -> dict[str, StoredFile]:
        """All objects and folders, without those in sub-folders; names of folders end with "/"."""

        def request() -> list[dict[str, Any]]:
            self._files.invalidate_cache()
            found: list[dict[str, Any]] = self._files.ls(self._root, detail=True)
            return found

        try:
            found = self._request("", request)
        except FileNotFoundError:
            return {}
        out = {}
        for info in found:
            parent, _, name = str(info["name"]).rstrip("/").rpartition("/")
            if name and parent.lstrip("/") == self._root.lstrip("/"):
                is_folder = info["type"] == "directory"
                out[name + "/" * is_folder] = StoredFile(int(info.get("size") or 0), _tag(info))
        self._sizes = {name: file.size for name, file in out.items()}
        return out

    def read(self, name: str) -> bytes:
        """Content of an object; a FileNotFoundError where there is none."""
        size = self._sizes.get(name, 0)
        return bytes(self._request(name, lambda: self._files.cat_file(self._at(name)), size))

    def write(self, name: str, content: bytes, *, new: bool = False) -> bool:
        """Write an object whole; False where `new`, and another one has that name.

        The store decides which of several writers is first where it has conditional writes, such as S3;
        others have a short window in which the last writer succeeds.
        """

        def request() -> None:
            if new:
                try:
                    self._files.pipe_file(self._at(name), content, mode="create")
                    return
                except (TypeError, OSError) as error:
                    code = _code(error)
                    if code in _EXISTS:
                        raise FileExistsError(name) from None
                    # A file system without the parameter, or a store without such writes.
                    if not (isinstance(error, TypeError) or code in _UNCONDITIONAL):
                        raise
                if self._files.exists(self._at(name)):
                    raise FileExistsError(name)
            self._files.pipe_file(self._at(name), content)

        try:
            self._request(name, request, len(content))
        except FileExistsError:
            # An attempt whose answer was lost may have written it.
            return self.read(name) == content
        except FileNotFoundError as error:
            raise InputError(f"cannot be written ({reason(error)})", where=self.url) from None
        return True

    def delete(self, name: str) -> None:
        """Delete an object, if it is there."""
        try:
            self._request(name, lambda: self._files.rm_file(self._at(name)))
        except FileNotFoundError:
            return


def open_store(where: str | Path) -> Store:
    """The store of a path, or of a URL such as ``s3://bucket/data``; ``file://`` is a local path. Errors are
    those of :class:`ObjectStore`."""
    url = split_url(where)
    if url is None:
        return LocalStore(Path(where))
    protocol, rest = url
    if protocol in ("file", "local"):
        return LocalStore(Path(unquote(f"/{rest}")))
    if not rest.strip("/"):
        raise InputError("names no bucket", where=where, hint="such as s3://bucket/data")
    return ObjectStore(f"{protocol}://{rest}")


def _is_refusal(error: Exception) -> bool:
    """Whether another attempt would not help."""
    if any(cls.__name__ in _REFUSED for cls in type(error).__mro__):
        return True
    # The text is that of gcsfs, whose error has no code.
    return _code(error) in _REFUSED_CODES or str(error).startswith("Forbidden: ")


def _code(error: BaseException) -> str | int:
    """Code of a store's answer: that of S3 behind an error of s3fs, that of HTTP in one of gcsfs; else an
    empty text."""
    answer = getattr(error.__cause__, "response", None)
    stated = answer.get("Error") if isinstance(answer, dict) else None
    found = stated.get("Code") if stated else getattr(error, "code", None)
    return found if isinstance(found, str | int) else ""


def _quiet(files: Any) -> None:
    """Keep tracebacks and notes of requests off the screen: those that fail raise the error as well."""
    logger = logging.getLogger(type(files).__module__.partition(".")[0])
    if logger.level == logging.NOTSET:
        logger.setLevel(logging.CRITICAL)
    loop = getattr(files, "loop", None)
    if loop is not None and loop.get_exception_handler() is None:
        loop.call_soon_threadsafe(
            loop.set_exception_handler, lambda _, context: log.debug(reason(context.get("message")))
        )


def _tag(info: dict[str, Any]) -> str:
    keys = ("ETag", "etag", "md5Hash", "content_md5", "LastModified", "last_modified", "mtime", "created")
    return str(next((info[key] for key in keys if info.get(key)), ""))
