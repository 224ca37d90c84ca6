"""Locks of shards: one writer at a time, abandoned ones are taken over."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from mbtf_core.errors import PartialError
from mbtf_core.files.locks import brief_lock, shard_lock, take_lock


def lock_of(shard: Path) -> Path:
    return shard.with_name(f".{shard.stem}.lock")


def plant(shard: Path, text: str, age: float = 0.0) -> Path:
    """A lock that somebody else left."""
    lock = lock_of(shard)
    lock.write_text(text)
    then = time.time() - age
    os.utime(lock, (then, then))
    return lock


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    return tmp_path / "train-00003.npz"


def test_a_lock_is_exclusive_names_its_writer_and_is_removed(shard: Path) -> None:
    with shard_lock(shard) as held:
        assert held
        stored = json.loads(lock_of(shard).read_text())
        assert (stored["host"], stored["process"]) == (socket.gethostname(), os.getpid())
        assert stored["since"] == pytest.approx(time.time(), abs=60)
        with shard_lock(shard) as second:
            assert not second
        assert lock_of(shard).exists()
        with shard_lock(shard.with_name("train-00004.npz")) as other:
            assert other
    assert not lock_of(shard).exists()


def hold(shard: Path) -> subprocess.Popen[bytes]:
    """Another process that holds the lock until its standard input ends."""
    code = f"""
import sys
from pathlib import Path
from mbtf_core.files.locks import shard_lock
with shard_lock(Path({str(shard)!r})) as held:
    print(held, flush=True)
    sys.stdin.read()
"""
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout.readline() == b"True\n"
    return child


def test_the_lock_of_a_living_process_is_respected_however_old(shard: Path) -> None:
    child = hold(shard)
    try:
        assert json.loads(lock_of(shard).read_text())["process"] == child.pid
        for date in (0.0, time.time() + 1e6):
            os.utime(lock_of(shard), (date, date))
            with shard_lock(shard) as held:
                assert not held
    finally:
        child.communicate()
    assert not lock_of(shard).exists()


def test_the_lock_of_a_killed_process_is_taken_over_at_once(shard: Path) -> None:
    child = hold(shard)
    child.kill()
    child.communicate()
    assert lock_of(shard).exists()
    with shard_lock(shard) as held:
        assert held
        assert json.loads(lock_of(shard).read_text())["process"] == os.getpid()
    assert not lock_of(shard).exists()


def test_of_many_that_take_over_at_once_one_gets_it(shard: Path) -> None:
    plant(shard, json.dumps({"host": socket.gethostname(), "process": 1, "since": 0}))
    inside, most, gate = 0, 0, threading.Barrier(8)
    count = threading.Lock()

    def contend() -> None:
        nonlocal inside, most
        gate.wait()
        for _ in range(200):
            with shard_lock(shard) as held:
                if held:
                    with count:
                        inside += 1
                        most = max(most, inside)
                    time.sleep(0)
                    with count:
                        inside -= 1

    threads = [threading.Thread(target=contend) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1
    assert not lock_of(shard).exists()


@pytest.fixture
def no_advisory_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file itself is the lock."""

    def unsupported(handle: int, operation: int) -> None:
        raise OSError(errno.ENOSYS, "not implemented")

    monkeypatch.setattr("fcntl.flock", unsupported)


@pytest.mark.usefixtures("no_advisory_locks")
@pytest.mark.parametrize(
    ("age", "free"), [(0, False), (200, False), (400, True), (-200, False), (-400, True), (-1e8, True)]
)
def test_dates_of_locks_of_other_machines(
    shard: Path, monkeypatch: pytest.MonkeyPatch, age: float, free: bool
) -> None:
    """Compared with the time of the file system: the clock of this machine is a year behind."""
    with shard_lock(shard) as held:
        assert held
        text = lock_of(shard).read_text().replace(socket.gethostname(), "oak")
    plant(shard, text, age)
    now = time.time()
    monkeypatch.setattr("mbtf_core.files.locks.time.time", lambda: now - 3e7)
    with shard_lock(shard) as held:
        assert held is free
        assert lock_of(shard).exists()
    assert lock_of(shard).exists() is not free


@pytest.mark.usefixtures("no_advisory_locks")
def test_a_living_owner_renews_its_lock(shard: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mbtf_core.files.locks._RENEWAL_SECONDS", 0.01)
    with shard_lock(shard):
        os.utime(lock_of(shard), (0, 0))
        while lock_of(shard).stat().st_mtime == 0:
            time.sleep(0.01)
    assert not lock_of(shard).exists()


def test_a_brief_lock_is_waited_for_but_not_for_ever(shard: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = take_lock(shard)
    threading.Timer(0.1, held.release).start()
    with brief_lock(shard):
        pass
    held = take_lock(shard)
    monkeypatch.setattr("mbtf_core.files.locks._PATIENCE_SECONDS", 0.05)
    with pytest.raises(PartialError, match=f"process {os.getpid()} on"), brief_lock(shard):
        pass
    held.release()
