"""What ``--cluster`` takes: words, addresses, and files of a site; what is at fault is bad input."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.run.workers import local_config, read_cluster


def test_local_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(16)), raising=False)
    assert (local_config().workers, local_config().threads) == (4, 4)
    config = read_cluster("local:8")
    assert (config.engine, config.workers, config.threads) == ("local", 8, 2)
    many = read_cluster("local:64")
    assert many.threads == 1


def test_files_and_addresses(tmp_path: Path) -> None:
    file = tmp_path / "slurm.yaml"
    file.write_text(
        "engine: slurm\nworkers: 16\nthreads: 8\nmemory: 16GB\nwalltime: 2h\noptions: {queue: short}\n"
    )
    config = read_cluster(str(file))
    assert (config.engine, config.workers, config.memory, config.walltime) == ("slurm", 16, 16e9, 7200.0)
    assert config.options == {"queue": "short"}
    config = read_cluster("tcp://scheduler:8786")
    assert (config.address, config.timeout) == ("tcp://scheduler:8786", 30.0)
    file.write_text("address: tcp://scheduler:8786\ntimeout: 2min\n")
    config = read_cluster(str(file))
    assert (config.address, config.timeout) == ("tcp://scheduler:8786", 120.0)
