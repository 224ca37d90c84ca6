"""What a worker does with one shard: locks, other files, other plans."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.cluster.task import TaskResult
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.manifest import plan_digest
from mbtf_core.errors import InputError, LockedError, PartialError
from mbtf_core.locks import lock_file_of, take_lock
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.distribute_shards import distribute_shards, render_shard
from mbtf_gen.generation.folder import open_folder, read_run_plan
from mbtf_gen.job import Job
from mbtf_gen.planning.run_plan import plan_run

SHARD = "train-00001.npz"


@pytest.fixture
def arguments(tmp_path: Path) -> dict[str, Any]:
    """Of the task of a shard of a plane, whose data set is begun."""
    np.save(tmp_path / "plane.npy", np.full((4, 8), 0.5))
    queries = {"train": "400", "test": "10", "spp": 4, "test_spp": 4}
    options = {"material": str(tmp_path / "plane.npy"), "queries": queries}
    config = GeneratorConfig.model_validate(options | {"output": {"shard_queries": 100}})
    job = Job.prepare(config)
    open_folder(job, DataFolder.open(tmp_path / "out"), plan_run, False)
    return {
        "config": job.config.model_dump(mode="json"),
        "folder": str(tmp_path / "out"),
        "config_hash": job.config_hash,
        "plan": plan_digest(read_run_plan(tmp_path / "out").to_manifest()),
        "file": SHARD,
    }


def test_a_shard_is_rendered_once(arguments: dict[str, Any]) -> None:
    first, again = render_shard(**arguments), render_shard(**arguments)
    assert not lock_file_of(Path(arguments["folder"]) / SHARD).exists()
    assert (first["rendered"], again["rendered"]) == (True, False)
    assert first["record"] == again["record"]


def test_locks_of_dead_workers_elsewhere_do_not_count(arguments: dict[str, Any]) -> None:
    owner = {"host": "a machine that is gone", "process": 1, "since": time.time()}
    lock_file_of(Path(arguments["folder"]) / SHARD).write_text(json.dumps(owner))
    assert render_shard(**arguments)["rendered"]


def test_locks_of_living_processes_here_count(arguments: dict[str, Any]) -> None:
    lock = take_lock(Path(arguments["folder"]) / SHARD)
    assert lock is not None
    with pytest.raises(LockedError, match=SHARD):
        render_shard(**arguments)
    lock.release()
    assert render_shard(**arguments)["rendered"]


def test_other_files_plans_and_folders_are_refused(arguments: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="another plan"):
        render_shard(**arguments | {"plan": "0" * 64})
    with pytest.raises(InputError, match="does not see"):
        render_shard(**arguments | {"folder": str(tmp_path / "elsewhere")})
    np.save(tmp_path / "plane.npy", np.full((4, 8), 0.25))
    # What an earlier shard has read does not count.
    with pytest.raises(InputError, match="files differ"):
        render_shard(**arguments | {"config_hash": "0" * 64})


class FullDisk:
    """In place of a cluster: every task fails, but for one that has a result."""

    workers = 2
    tried = 0

    def __init__(self, number: int = 0, value: Any = None) -> None:
        self.number, self.value = number, value

    def run(self, tasks: list[Any]) -> Any:
        for task in tasks:
            self.tried += 1
            if self.tried == self.number:
                yield TaskResult(task, self.value)
            else:
                yield TaskResult(task, error="no space left", worker="node:1")


def test_samples_that_are_not_finite_end_the_run(arguments: dict[str, Any], tmp_path: Path) -> None:
    value = render_shard(**arguments)
    value["record"]["quarantined"]["nonfinite_samples"] = 9
    job = Job.prepare(GeneratorConfig.model_validate(arguments["config"]))
    plan = read_run_plan(tmp_path / "out")
    with pytest.raises(PartialError, match="NaN or infinite"):
        distribute_shards(job, DataFolder.open(tmp_path / "out"), job.shards, plan, FullDisk(1, value))  # type: ignore[arg-type]


def test_a_full_disk_ends_the_run(arguments: dict[str, Any], tmp_path: Path) -> None:
    config = GeneratorConfig.model_validate(arguments["config"] | {"output": {"shard_queries": 4}})
    job = Job.prepare(config)
    disk = FullDisk()
    with pytest.raises(PartialError, match=r"8 shard\(s\) failed, 103 are left.*no space left \(on node:1\)"):
        distribute_shards(
            job,
            DataFolder.open(tmp_path / "out"),
            job.shards,
            read_run_plan(tmp_path / "out"),
            disk,  # type: ignore[arg-type]
        )
    assert disk.tried == 8
    # Failures that are not in a row do not end it.
    disk = FullDisk(6, render_shard(**arguments))
    with pytest.raises(PartialError, match=r"13 shard\(s\) failed"):
        distribute_shards(
            job,
            DataFolder.open(tmp_path / "out"),
            job.shards,
            read_run_plan(tmp_path / "out"),
            disk,  # type: ignore[arg-type]
        )
    assert disk.tried == 14
