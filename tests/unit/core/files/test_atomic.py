"""Files are absent or complete, whatever happens while they are written."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
import stat
import threading
from pathlib import Path

import pytest

from mbtf_core.errors import InputError, PartialError
from mbtf_core.files import atomic


def no_leftovers(folder: Path) -> bool:
    return not any(p.name.endswith(".tmp") for p in folder.iterdir())


@pytest.mark.parametrize("through_name", [False, True])
def test_a_full_disk_is_partial_and_keeps_the_old_file(tmp_path: Path, through_name: bool) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def full(target: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(PartialError, match="No space left on device") as caught:
        (atomic.write_through if through_name else atomic.write_file)(path, full)
    assert caught.value.exit_code == 4
    assert caught.value.where == str(path)
    assert "run the same command again" in caught.value.hint
    assert path.read_bytes() == b"old"
    assert no_leftovers(tmp_path)


def test_the_data_are_synced_before_the_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []
    for name in ("fsync", "replace", "link"):
        real = getattr(os, name)
        monkeypatch.setattr(atomic.os, name, lambda *a, n=name, f=real: events.append(n) or f(*a))
    for operation, expected in (
        (lambda: atomic.write_file(tmp_path / "a", lambda stream: None), ["fsync", "replace", "fsync"]),
        (lambda: atomic.write_through(tmp_path / "b", Path.touch), ["fsync", "replace", "fsync"]),
        (lambda: atomic.create_file(tmp_path / "c", b"text"), ["fsync", "link", "fsync"]),
        (lambda: atomic.remove_file(tmp_path / "a"), ["fsync"]),
    ):
        events.clear()
        operation()
        assert events == expected


def test_of_several_creators_one_wins_and_its_content_stays(tmp_path: Path) -> None:
    path = tmp_path / "a"
    gate, won = threading.Barrier(8), []

    def create(number: int) -> None:
        # Temporary names are a process's own; threads stand in for processes here.
        gate.wait()
        if atomic.create_file(path.with_name("a"), str(number).encode() * 1000):
            won.append(number)

    names = itertools.count()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(atomic, "temporary_of", lambda p: p.with_name(f".a.{next(names)}.tmp"))
        threads = [threading.Thread(target=create, args=(n,)) for n in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(won) == 1
    assert path.read_bytes() == str(won[0]).encode() * 1000
    assert no_leftovers(tmp_path)


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP])
def test_files_without_hard_links(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unsupported(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(atomic.os, "link", unsupported)
    assert atomic.create_file(tmp_path / "a", b"first")
    assert not atomic.create_file(tmp_path / "a", b"second")
    assert (tmp_path / "a").read_bytes() == b"first"
    assert no_leftovers(tmp_path)


def test_a_leftover_that_is_the_file_itself_does_not_spoil_it(tmp_path: Path) -> None:
    """A kill between link and unlink leaves two names of one file; a process of the same number follows."""
    path = tmp_path / "a"
    path.write_bytes(b"whole")
    os.link(path, atomic.temporary_of(path))
    assert not atomic.create_file(path, b"other content")
    assert path.read_bytes() == b"whole"
    assert no_leftovers(tmp_path)


def test_any_changed_byte_of_a_checksummed_document_is_found(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    data = {"name": "α", "rows": [1, 2.5, None], "checksum": "of before", "nested": {"zeros": "0" * 64}}
    atomic.write_checksummed(path, data)
    assert atomic.parse_checksummed(path.read_bytes(), path) == {
        k: v for k, v in data.items() if k != "checksum"
    }
    content = path.read_bytes()
    for at in range(len(content)):
        for mask in (1, 0x20, 0x80):
            changed = bytearray(content)
            changed[at] ^= mask
            with pytest.raises(InputError):
                atomic.parse_checksummed(bytes(changed), path)
    for other in (content[:-1], content + b" ", content.replace(b"\n", b"\r\n"), b"{}"):
        with pytest.raises(InputError):
            atomic.parse_checksummed(other, path)


def test_the_checksum_is_that_of_the_file_with_its_digits_at_zero(tmp_path: Path) -> None:
    atomic.write_checksummed(tmp_path / "a.json", {"rows": 3})
    content = (tmp_path / "a.json").read_bytes()
    stored = json.loads(content)["checksum"]
    assert stored == hashlib.sha256(content.replace(stored.encode(), b"0" * 64)).hexdigest()
    assert list(json.loads(content)) == ["rows", "checksum"]


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
@pytest.mark.parametrize("folder", [False, True])
def test_a_failing_sync_is_partial(
    folder: bool, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.fsync

    def fails(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode) == folder:
            raise OSError(number, os.strerror(number))
        real(handle)

    monkeypatch.setattr(atomic.os, "fsync", fails)
    with pytest.raises(PartialError, match=os.strerror(number)):
        atomic.write_text(tmp_path / "a", "text")
    assert no_leftovers(tmp_path)


def test_write_errors_of_openexr_are_those_of_the_system(tmp_path: Path) -> None:
    def write(temporary: Path) -> None:
        raise RuntimeError(f'Cannot write image file "{temporary}". No space left on device.')

    with pytest.raises(PartialError, match=r"a\.exr: cannot be written \(No space left on device\)"):
        atomic.write_through(tmp_path / "a.exr", write)
    assert not list(tmp_path.iterdir())
