"""Requests to an object store: tried again, refused or given up; the bounded cache of its objects."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.object_stores import memory_store, silent_server

import mbtf_core.data.store
from mbtf_core.data.file_cache import FileCache
from mbtf_core.data.store import ObjectStore
from mbtf_core.errors import InputError, PartialError
from mbtf_core.paths import split_url


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ObjectStore]:
    monkeypatch.setattr(mbtf_core.data.store, "_FIRST_PAUSE", 0.001)
    with memory_store(tmp_path) as url:
        found = ObjectStore(url)
        found.patience = 60.0
        yield found


class Flaky:
    """A file system whose requests fail: `before` or after they are carried out, so many times."""

    def __init__(self, files: Any, error: Exception, times: int, before: bool = True) -> None:
        self._files, self._error, self.left, self._before = files, error, times, before

    def __getattr__(self, name: str) -> Callable[..., Any]:
        function = getattr(self._files, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            if name == "invalidate_cache" or not self.left:
                return function(*args, **kwargs)
            if not self._before:
                function(*args, **kwargs)
            self.left -= 1
            raise self._error

        return call


def test_a_new_object_never_replaces_another(store: ObjectStore) -> None:
    assert store.write("a", b"one", new=True)
    assert not store.write("a", b"two", new=True)
    assert store.read("a") == b"one"
    assert store.write("a", b"one", new=True)


@pytest.mark.parametrize("new", [False, True])
def test_an_object_is_written_although_the_answer_is_lost(store: ObjectStore, new: bool) -> None:
    store._files = Flaky(store._files, ConnectionResetError("cut"), 1, before=False)
    assert store.write("a", b"one", new=new)
    assert store.read("a") == b"one"


class Answer(Exception):
    """A store's answer, as s3fs keeps it in the cause of its error."""

    def __init__(self, code: str) -> None:
        self.response = {"Error": {"Code": code}}


def answered(code: str) -> OSError:
    """An error of s3fs for an answer."""
    error = OSError(22, "refused")
    error.__cause__ = Answer(code)
    return error


@pytest.mark.parametrize("code", ["PreconditionFailed", "NotImplemented"])
def test_answers_to_conditional_writes(
    store: ObjectStore, monkeypatch: pytest.MonkeyPatch, code: str
) -> None:
    original = store._files.pipe_file

    def pipe_file(path: str, value: bytes, mode: str = "overwrite") -> None:
        if mode == "create" and (code == "NotImplemented" or store._files.exists(path)):
            raise answered(code)
        original(path, value)

    monkeypatch.setattr(store._files, "pipe_file", pipe_file)
    assert store.write("a", b"one", new=True)
    assert not store.write("a", b"two", new=True)
    assert store.write("a", b"one", new=True)
    assert store.read("a") == b"one"


@pytest.mark.parametrize("error", [ConnectionResetError("cut"), TimeoutError(), RuntimeError("botocore")])
def test_requests_are_tried_again(store: ObjectStore, error: Exception) -> None:
    store.write("a", b"one")
    store._files = Flaky(store._files, error, 3)
    assert store.read("a") == b"one"


def test_a_store_that_is_gone_is_given_up(store: ObjectStore, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    clock = 0.0

    def sleep(seconds: float) -> None:
        nonlocal clock
        clock += seconds
        pauses.append(seconds)

    monkeypatch.setattr(mbtf_core.data.store.time, "sleep", sleep)
    monkeypatch.setattr(mbtf_core.data.store.time, "monotonic", lambda: clock)
    store._files = Flaky(store._files, ConnectionResetError("cut"), -1)
    with pytest.raises(PartialError, match=r"memory://data/x/a: the store cannot be reached \(cut\)"):
        store.read("a")
    assert pauses[0] < pauses[-1]
    assert 30.0 < sum(pauses) <= 60.0
    # Other requests do not wait again, until one succeeds.
    pauses.clear()
    with pytest.raises(PartialError):
        store.list()
    assert pauses == []
    store._files.left = 0
    assert store.list() == {}
    assert not store._lost.is_set()


def test_a_store_that_never_answers_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip(
        "s3fs", reason="no s3fs; to enable: pip install 'mbtf[stores]'"
    ).S3FileSystem.clear_instance_cache()
    with silent_server() as port:
        for name, value in (("ACCESS_KEY_ID", "x"), ("SECRET_ACCESS_KEY", "x"), ("DEFAULT_REGION", "x")):
            monkeypatch.setenv(f"AWS_{name}", value)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        monkeypatch.setenv("MBTF_STORE_PATIENCE", "1")
        store = ObjectStore("s3://bucket/data")
        for request in (store.list, lambda: store.read("a"), lambda: store.write("a", b"one", new=True)):
            with pytest.raises(PartialError, match=r"s3://bucket/data.*not answer") as caught:
                request()
            assert "MBTF_STORE_PATIENCE" in caught.value.hint


NoCredentialsError = type("NoCredentialsError", (Exception,), {})
HttpError = type("HttpError", (Exception,), {"code": 401})


@pytest.mark.parametrize(
    "error",
    [
        *(PermissionError("AccessDenied"), NoCredentialsError("none found"), HttpError("Anonymous caller")),
        *(OSError("Forbidden: b/bucket"), answered("PermanentRedirect")),
    ],
)
def test_refusals_are_not_tried_again(store: ObjectStore, error: Exception) -> None:
    store._files = Flaky(store._files, error, 1)
    with pytest.raises(InputError, match="the store refuses it"):
        store.read("a")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("s3://bucket/data", ("s3", "bucket/data")),
        ("s3://bucket//a/./b//", ("s3", "bucket/a/b")),
        ("S3A://bucket/Some Data%20#1?x=y", ("s3a", "bucket/Some Data%20#1?x=y")),
        (Path("gs://bucket/x"), ("gs", "bucket/x")),
        ("C:/shards", None),
        ("a/b:/c", None),
    ],
)
def test_urls_are_recognized(text: object, expected: tuple[str, str] | None) -> None:
    assert split_url(text) == expected


def content(number: int) -> bytes:
    return bytes([number]) * 100


def fetch(cache: FileCache, number: int) -> bool:
    """Whether a file was downloaded."""
    downloads: list[int] = []

    def download() -> bytes:
        downloads.append(number)
        return content(number)

    found = cache.fetch(hashlib.sha256(content(number)).hexdigest(), ".npz", 100, download)
    assert found.read_bytes() == content(number)
    return bool(downloads)


def test_the_least_recently_used_files_make_room(tmp_path: Path) -> None:
    cache = FileCache(tmp_path / "cache", limit=600)
    for number in range(6):
        assert fetch(cache, number)
        path = cache.folder / f"{hashlib.sha256(content(number)).hexdigest()}.npz"
        os.utime(path, (number, number))
    assert not fetch(cache, 0)
    assert fetch(cache, 6)
    assert sum(path.stat().st_size for path in cache.folder.iterdir()) <= 600
    assert not fetch(cache, 0)
    assert fetch(cache, 1)


def test_a_damaged_copy_is_downloaded_again(tmp_path: Path) -> None:
    fetch(FileCache(tmp_path), 1)
    (path,) = tmp_path.iterdir()
    kept = FileCache(tmp_path)
    assert not fetch(kept, 1)
    # Another process has not read it yet; this one sees that it has changed.
    for cache, changed in ((FileCache(tmp_path), b"short"), (kept, b"x" + content(1)[1:])):
        path.write_bytes(changed)
        os.utime(path, (1, 1))
        assert fetch(cache, 1)
        assert not fetch(cache, 1)


def test_another_digest_is_refused(tmp_path: Path) -> None:
    cache = FileCache(tmp_path)
    with pytest.raises(InputError, match="SHA-256"):
        cache.fetch("0" * 64, ".npz", 3, lambda: b"abc")
    assert list(tmp_path.iterdir()) == []


def test_unfinished_files_of_others_stay_for_a_day(tmp_path: Path) -> None:
    cache = FileCache(tmp_path, limit=0)
    fresh, old = tmp_path / ".a.npz.00000000-1.tmp", tmp_path / ".b.npz.00000000-1.tmp"
    for path in (fresh, old):
        path.write_bytes(content(1))
    os.utime(old, (time.time() - 1e5, time.time() - 1e5))
    fetch(cache, 2)
    assert fresh.exists()
    assert not old.exists()
