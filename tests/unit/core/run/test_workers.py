"""What ``--cluster`` takes: words, addresses, and files of a site; what is at fault is bad input."""

from __future__ import annotations

import pytest

from mbtf_core.run.workers import local_config, read_cluster


def test_local_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(16)), raising=False)
    assert (local_config().workers, local_config().threads) == (4, 4)
    config = read_cluster("local:8")
    assert (config.engine, config.workers, config.threads) == ("local", 8, 2)
    many = read_cluster("local:64")
    assert many.threads == 1
