"""Shards are written beside the rendering: in order, all of them, and failures are not lost."""

from __future__ import annotations

import threading

import pytest

from mbtf_gen.generation.writer import ShardWriter


def test_everything_is_written_in_order_and_off_the_main_thread() -> None:
    done: list[str] = []
    names: set[str] = set()

    def write(number: int) -> None:
        names.add(threading.current_thread().name)
        done.append(f"write {number}")

    with ShardWriter() as writer:
        for number in range(5):
            writer.submit(lambda n=number: write(n), lambda n=number: done.append(f"after {n}"))
    assert done == [f"{what} {n}" for n in range(5) for what in ("write", "after")]
    assert names == {"shard writer"}


def test_what_waits_is_bounded() -> None:
    gate, submitted = threading.Event(), []
    started = threading.Event()

    def block() -> None:
        started.set()
        gate.wait()

    def fill(writer: ShardWriter) -> None:
        for number in range(4):
            writer.submit(block, lambda: None)
            submitted.append(number)

    with ShardWriter(waiting=1) as writer:
        filler = threading.Thread(target=fill, args=(writer,))
        filler.start()
        started.wait()
        # One is being written, one waits; the third submission cannot come to its end.
        while len(submitted) < 2:
            pass
        assert submitted == [0, 1]
        gate.set()
        filler.join()
    assert submitted == [0, 1, 2, 3]


def test_a_failure_reaches_the_next_submission_and_nothing_more_is_written() -> None:
    done: list[str] = []

    def fail() -> None:
        raise OSError("no room")

    failed = threading.Event()

    def run() -> None:
        with ShardWriter() as writer:
            writer.submit(fail, failed.set)
            failed.wait()
            writer.submit(lambda: done.append("write"), lambda: done.append("after"))
            done.append("not reached")

    with pytest.raises(OSError, match="no room"):
        run()
    assert done == []


def test_the_last_failure_reaches_the_end() -> None:
    def fail() -> None:
        raise OSError("no room")

    with pytest.raises(OSError, match="no room"), ShardWriter() as writer:
        writer.submit(fail, lambda: None)


def test_an_interruption_waits_for_what_was_handed_over() -> None:
    gate, done = threading.Event(), []

    def write() -> None:
        gate.wait()
        done.append("written")

    def run() -> None:
        with ShardWriter() as writer:
            writer.submit(write, lambda: done.append("after"))
            threading.Timer(0.05, gate.set).start()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert done == ["written", "after"]
