"""The bounded cache: least recently used files go first; what has another digest never gets in."""

from __future__ import annotations

import hashlib
import os
import threading
import time
from pathlib import Path

import pytest

from mbtf_core.data.file_cache import FileCache
from mbtf_core.errors import InputError


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


def test_threads_share_a_download(tmp_path: Path) -> None:
    cache, downloads = FileCache(tmp_path), []

    def download() -> bytes:
        downloads.append(1)
        time.sleep(0.05)
        return content(1)

    digest = hashlib.sha256(content(1)).hexdigest()
    threads = [threading.Thread(target=cache.fetch, args=(digest, "", 100, download)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(downloads) == 1
