"""What a worker does with one shard: locks, other files, other plans; failures of many."""

from __future__ import annotations

import json
import pickle
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mbtf_core.data.folder import DataFolder
from mbtf_core.errors import InputError, PartialError
from mbtf_core.files.locks import lock_file_of
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Result, exhausted
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.generation.folder import open_folder
from mbtf_gen.generation.run import ShardRun, render_shard, render_shards
from mbtf_gen.planning.job import Job, received_job
from mbtf_gen.planning.run_plan import plan_run

SHARD = "train-00001.npz"


@pytest.fixture
def run(tmp_path: Path) -> ShardRun:
    """That of a plane, whose data set is begun."""
    np.save(tmp_path / "plane.npy", np.full((4, 8), 0.5))
    queries = {"train": "400", "test": "10", "spp": 4, "test_spp": 4}
    options = {"material": str(tmp_path / "plane.npy"), "queries": queries}
    config = GeneratorConfig.model_validate(options | {"output": {"shard_queries": 100}})
    job = Job.load(config)
    folder = DataFolder.open(tmp_path / "out")
    return ShardRun(job, folder, open_folder(job, folder, plan_run))


def render(run: ShardRun) -> dict[str, Any]:
    """Render a shard as a worker does: what reaches it is pickled."""
    entry = next(entry for entry in run.job.shards if entry.file == SHARD)
    found: dict[str, Any] = exhausted(render_shard(pickle.loads(pickle.dumps(run)), entry))
    return found


def test_locks_of_dead_workers_elsewhere_do_not_count(run: ShardRun) -> None:
    owner = {"host": "a machine that is gone", "process": 1, "since": time.time()}
    lock_file_of(run.folder.workspace / SHARD).write_text(json.dumps(owner))
    assert render(run)["rendered"]


def test_other_files_plans_and_folders_are_refused(run: ShardRun, tmp_path: Path) -> None:
    run.digest = "0" * 64
    with pytest.raises(InputError, match="another plan"):
        render(run)
    with pytest.raises(InputError, match="does not see"):
        render(ShardRun(run.job, DataFolder.open(tmp_path / "elsewhere"), run.plan))
    sent = pickle.dumps(run.job)
    received_job.cache_clear()
    np.save(tmp_path / "plane.npy", np.full((4, 8), 0.25))
    with pytest.raises(InputError, match="files differ"):
        pickle.loads(sent)


class FullDisk(Runner):
    """Every item fails."""

    workers, here, tried = 2, False, 0

    def map(self, function: Any, items: Any, **options: Any) -> Any:
        for item in items:
            self.tried += 1
            yield Result(item.name, error="no space left", hint="make room", worker="node:1")


def test_a_full_disk_ends_the_run(run: ShardRun) -> None:
    output = run.job.config.output.model_copy(update={"shard_queries": 4})
    job, disk = Job.load(run.job.config.model_copy(update={"output": output})), FullDisk()
    first = r"8 shard\(s\) failed, 103 are left.*no space left \(on node:1\)\n  make room"
    with pytest.raises(PartialError, match=first):
        render_shards(ShardRun(job, run.folder, run.plan), job.shards, disk)
    assert disk.tried == 8
