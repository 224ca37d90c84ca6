"""What --cluster accepts."""

from __future__ import annotations

from pathlib import Path

import pytest

from mbtf_core.errors import InputError, UsageError
from mbtf_core.run.workers import local_config, read_cluster


def test_local_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(16)), raising=False)
    assert (local_config().workers, local_config().threads) == (4, 4)
    config = read_cluster("local:8")
    assert not isinstance(config, str)
    assert (config.engine, config.workers, config.threads) == ("local", 8, 2)
    many = read_cluster("local:64")
    assert not isinstance(many, str)
    assert many.threads == 1


def test_files_and_addresses(tmp_path: Path) -> None:
    file = tmp_path / "slurm.yaml"
    file.write_text(
        "engine: slurm\nworkers: 16\nthreads: 8\nmemory: 16GB\nwalltime: 2h\noptions: {queue: short}\n"
    )
    config = read_cluster(str(file))
    assert not isinstance(config, str)
    assert (config.engine, config.workers, config.memory, config.walltime) == ("slurm", 16, 16e9, 7200.0)
    assert config.options == {"queue": "short"}
    assert read_cluster("tcp://scheduler:8786") == "tcp://scheduler:8786"


@pytest.mark.parametrize("where", ["lokal", "local:0", "local:", "local:-1", "http://x", ""])
def test_other_words_are_refused(where: str) -> None:
    with pytest.raises(UsageError, match="is no cluster"):
        read_cluster(where)


def test_faults_of_the_file_are_named(tmp_path: Path) -> None:
    file = tmp_path / "slurm.yaml"
    file.write_text("engine: slurm\nworker: 16\n")
    with pytest.raises(InputError, match=r"slurm.yaml:2.*worker"):
        read_cluster(str(file))
    with pytest.raises(InputError):
        read_cluster(str(tmp_path / "missing.yaml"))
