"""Tasks on a local cluster: results, failures, and workers that die."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support import run_tasks

from mbtf_core.errors import InputError, PartialError
from mbtf_core.run import cluster as module
from mbtf_core.run import task
from mbtf_core.run.cluster import open_runner
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item
from mbtf_core.run.workers import ClusterConfig, local_config, read_cluster


@pytest.fixture(scope="module")
def cluster() -> Iterator[Runner]:
    pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")
    with open_runner("local:2", lambda line: None) as opened:
        yield opened


@pytest.mark.parametrize("task", [run_tasks.die_at_first, run_tasks.fail_at_first])
def test_a_task_is_run_again(task: Callable[..., int], cluster: Runner, tmp_path: Path) -> None:
    """When its worker dies, and when it fails by a bug."""
    arguments = {"marks": str(tmp_path), "times": 2}
    (done,) = cluster.map(task, [Item("again", arguments)])
    assert (done.value, done.error) == (3, "")


def test_tasks_whose_files_are_locked_are_tried_later(
    cluster: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PAUSE_SECONDS", 0.2)
    arguments = {"marks": str(tmp_path), "times": 3}
    (done,) = cluster.map(run_tasks.locked_at_first, [Item("locked", arguments)])
    assert (done.value, done.error) == (4, "")
    monkeypatch.setattr(module, "_LOCKED_SECONDS", 0.5)
    (done,) = cluster.map(run_tasks.locked_at_first, [Item("for ever", arguments | {"times": 1000})])
    assert done.error == "folder: is being written by another process"


def test_workers_that_die_each_time_are_reported(cluster: Runner) -> None:
    (done,) = cluster.map(run_tasks.fail, [Item("deadly", {"kind": "kill"})])
    assert "died each time" in done.error
    # Also tasks for GPUs run where none is stated.
    (after,) = cluster.map(run_tasks.double, [Item("after", {"x": 1}, gpu=True)])
    assert after.value == 2


@pytest.mark.timeout(120)
def test_workers_that_dask_cannot_close_are_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")

    async def close(nanny: Any, *arguments: Any, **options: Any) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(distributed.Nanny, "close", close)
    monkeypatch.setattr(module, "_CLOSE_SECONDS", 0.5)
    # A worker of another cluster.
    other = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(100,), name="Dask Worker")
    other.start()
    before = set(multiprocessing.active_children())
    with open_runner("local:1", lambda line: None):
        (worker,) = set(multiprocessing.active_children()) - before
    worker.join()
    # Dask may have waited for it first: then there is no exit code.
    assert worker.exitcode in (-signal.SIGKILL, None)
    with pytest.raises(ProcessLookupError):
        os.kill(worker.pid, 0)
    assert other.is_alive()
    other.kill()


def test_a_scheduler_that_is_not_there_is_bad_input(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    (tmp_path / "scheduler.yaml").write_text("address: tcp://127.0.0.1:9\ntimeout: 1s\n")
    runner = open_runner(str(tmp_path / "scheduler.yaml"), lambda line: None)
    with pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9"), runner:
        pass


@pytest.fixture
def one_worker() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
    ) as started:
        yield started


@pytest.mark.parametrize(
    ("option", "fault", "says"),
    [
        ("timeout", "ends", ""),
        ("timeout", "hangs", "no answer within 1 s"),
        ("start_timeout", "has no worker", "no worker within 1s"),
    ],
)
def test_a_cluster_that_is_lost_leaves_resumable_work(
    one_worker: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, fault: str, says: str
) -> None:
    monkeypatch.setattr(module, "_LOOK_SECONDS", 0.2)
    answers = threading.Event()
    begin = {
        "ends": one_worker.close,
        # Its connections stay open.
        "hangs": lambda: one_worker.loop.add_callback(answers.wait),
        "has no worker": lambda: one_worker.scale(0),
    }
    path = tmp_path / "scheduler.yaml"
    path.write_text(f"address: {one_worker.scheduler_address}\n{option}: 1s\n")
    with ExitStack() as stack:
        # The runner closes before a hanging scheduler answers.
        stack.callback(answers.set)
        opened = stack.enter_context(open_runner(str(path), lambda line: None))
        results = opened.map(run_tasks.double, (Item(f"x{i}", {"x": i}) for i in range(10**6)))
        next(results)
        begin[fault]()
        with pytest.raises(PartialError, match=f"the cluster is lost .*{says}"):
            list(results)


def test_a_worker_with_several_threads_runs_one_task_at_a_time() -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=4, processes=True, dashboard_address="127.0.0.1:0"
        ) as started,
        open_runner(started.scheduler_address, lambda line: None) as opened,
    ):
        found = list(opened.map(run_tasks.alone, (Item(f"x{i}") for i in range(16))))
        assert [done.value for done in found] == 16 * [True]


def test_what_a_job_needs_comes_beside_what_tasks_need_and_what_a_site_configures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dask_jobqueue = pytest.importorskip("dask_jobqueue")
    import dask

    job: list[str] = []
    own: dict[str, Any] = {"worker_extra_args": ["--local-directory", "/scratch"], "queue": "short"}
    own["log_directory"] = str(tmp_path / "logs")
    monkeypatch.setattr("shutil.which", lambda command: f"/usr/bin/{command}")
    adapt = lambda self, **numbers: job.extend(self.job_script().splitlines())  # noqa: E731
    monkeypatch.setattr(dask_jobqueue.SLURMCluster, "adapt", adapt)
    prologue = {"jobqueue.slurm.job-script-prologue": ["module load site"], "jobqueue.slurm.account": "site"}
    with dask.config.set(prologue):
        slurm = ClusterConfig(
            engine="slurm", options={"interface": "lo", **own}, threads=8, gpus=1, memory=16e9, walltime=7200
        )
        with warnings.catch_warnings(), module._workers(slurm, []):
            warnings.simplefilter("error")
    assert job.index("module load site") < job.index(f"export {task.THREADS_VARIABLE}=8")
    assert "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False" in job
    assert {"#SBATCH --cpus-per-task=8", "#SBATCH -p short", "#SBATCH -A site"} <= set(job)
    for words in (
        *("--nthreads 1", "--preload mbtf_core.run.task", "--resources GPU=1"),
        *("--lifetime 6480s", "--local-directory /scratch"),
    ):
        assert words in job[-1]


def test_workers_of_this_machine_divide_its_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(task.GPUS_VARIABLE, "2")
    handlers: dict[Any, Any] = {}
    monkeypatch.setattr("signal.signal", handlers.__setitem__)
    for visible, name, expected in ((None, 1, "2,3"), ("4,5,6,7", 1, "6,7"), ("4,5,6,7", 0, "4,5")):
        if visible is None:
            monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
        else:
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        task.dask_setup(SimpleNamespace(name=name))
        assert os.environ["CUDA_VISIBLE_DEVICES"] == expected
    # The signal of Ctrl-C is the command's.
    assert handlers == {signal.SIGINT: signal.SIG_IGN}


def test_an_interruption_while_waiting_for_jobs_is_one(tmp_path: Path) -> None:
    pytest.importorskip("dask_jobqueue", reason="no dask-jobqueue; to enable: pip install 'mbtf[cluster]'")
    for name, text in (("sbatch", "echo Submitted batch job 5"), ("scancel", "exit 0")):
        (tmp_path / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / name).chmod(0o755)
    (tmp_path / "site.yaml").write_text("engine: slurm\nworkers: 1\noptions: {interface: lo}\n")
    program = (
        "import os, signal\n"
        "from mbtf_core.run.cluster import open_runner\n"
        "def note(line): signal.setitimer(signal.ITIMER_REAL, 0.5)\n"
        "signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))\n"
        "try:\n"
        "    with open_runner('site.yaml', note): pass\n"
        "except KeyboardInterrupt: print('interrupted')\n"
    )
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.stdout == "interrupted\n", done.stderr


def test_local_workers_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda pid: set(range(16)), raising=False)
    assert (local_config().workers, local_config().threads) == (4, 4)
    config = read_cluster("local:8")
    assert (config.engine, config.workers, config.threads) == ("local", 8, 2)
    many = read_cluster("local:64")
    assert many.threads == 1
