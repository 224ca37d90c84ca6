"""Locks of shards: one writer at a time, abandoned ones are taken over."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mbtf_gen.locks import STALE_SECONDS, shard_lock


def lock_of(shard: Path) -> Path:
    return shard.with_name(f".{shard.stem}.lock")


def plant(shard: Path, text: str, age: float = 0.0) -> Path:
    """A lock that somebody else left."""
    lock = lock_of(shard)
    lock.write_text(text)
    then = time.time() - age
    os.utime(lock, (then, then))
    return lock


def owner(host: str, process: int) -> str:
    return json.dumps({"host": host, "process": process, "since": 0})


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


def test_an_error_inside_releases_the_lock(shard: Path) -> None:
    with pytest.raises(RuntimeError, match="boom"), shard_lock(shard):
        raise RuntimeError("boom")
    assert not lock_of(shard).exists()
    with shard_lock(shard) as held:
        assert held


def test_the_lock_of_a_dead_process_is_taken_over(shard: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    plant(shard, owner(socket.gethostname(), child.pid))
    with shard_lock(shard) as held:
        assert held
        assert json.loads(lock_of(shard).read_text())["process"] == os.getpid()


def test_the_lock_of_a_living_process_is_respected_however_old(shard: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        text = owner(socket.gethostname(), child.pid)
        lock = plant(shard, text, age=STALE_SECONDS + 60)
        with shard_lock(shard) as held:
            assert not held
        assert lock.read_text() == text
    finally:
        child.communicate(b"\n")


def test_a_lock_with_our_own_number_from_an_earlier_life_is_taken_over(shard: Path) -> None:
    plant(shard, owner(socket.gethostname(), os.getpid()))
    with shard_lock(shard) as held:
        assert held


def test_locks_of_other_machines_count_by_age(shard: Path) -> None:
    text = owner(f"{socket.gethostname()}-other", 1)
    plant(shard, text, age=STALE_SECONDS - 60)
    with shard_lock(shard) as held:
        assert not held
    plant(shard, text, age=STALE_SECONDS + 60)
    with shard_lock(shard) as held:
        assert held


@pytest.mark.parametrize("text", ["", "{", "[]", '{"host": "x"}', '{"host": "x", "process": "y"}'])
def test_half_written_locks_are_respected_for_seconds_only(text: str, shard: Path) -> None:
    plant(shard, text, age=0)
    with shard_lock(shard) as held:
        assert not held
    plant(shard, text, age=30)
    with shard_lock(shard) as held:
        assert held
