"""Tasks on a local cluster: results, failures, and workers that die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support import run_tasks

from mbtf_core.errors import InputError, PartialError, UsageError
from mbtf_core.run import cluster as module
from mbtf_core.run import task
from mbtf_core.run.cluster import open_runner
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import Item, packed, run_task
from mbtf_core.run.workers import ClusterConfig, local_config, read_cluster


@pytest.fixture(scope="module")
def cluster() -> Iterator[Runner]:
    pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")
    with open_runner("local:2", lambda line: None) as opened:
        yield opened


def test_a_batch_system_that_refuses_the_jobs_is_no_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("dask_jobqueue", reason="no dask-jobqueue; to enable: pip install 'mbtf[cluster]'")
    command = tmp_path / "sbatch"
    command.write_text("#!/bin/sh\necho 'sbatch: error: invalid partition' >&2\nexit 1\n")
    command.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    file = tmp_path / "site.yaml"
    file.write_text("engine: slurm\nworkers: 1\nstart_timeout: 30s\noptions: {interface: lo}\n")
    with (
        pytest.raises(InputError, match=r"refuses the jobs \(sbatch: error: invalid partition\)"),
        open_runner(str(file), lambda line: None),
    ):
        pass
    assert "Traceback" not in capfd.readouterr().err


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


def test_a_task_is_run_again_when_its_worker_dies(cluster: Runner, tmp_path: Path) -> None:
    arguments = {"marks": str(tmp_path), "times": 2}
    (done,) = cluster.map(run_tasks.die_at_first, [Item("dies", arguments)])
    assert (done.value, done.error) == (3, "")


def test_a_task_is_run_again_when_it_fails_by_a_bug(cluster: Runner, tmp_path: Path) -> None:
    arguments = {"marks": str(tmp_path), "times": 2}
    (done,) = cluster.map(run_tasks.fail_at_first, [Item("flaky", arguments)])
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
    (after,) = cluster.map(run_tasks.double, [Item("after", {"x": 1})])
    assert after.value == 2


def test_tasks_for_gpus_run_where_none_is_stated(cluster: Runner) -> None:
    (done,) = cluster.map(run_tasks.double, [Item("gpu", {"x": 3}, gpu=True)])
    assert done.value == 6


def test_other_versions_are_refused() -> None:
    call, _, folder = packed(run_tasks.double, Item("x", {"x": 1}))
    found = run_task(call, "0.0.0", folder)
    assert found["fatal"]
    assert "version" in found["error"]
    assert "version" in found["hint"]


def test_without_dask_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"mbtf\[cluster\]"), open_runner("local", lambda line: None):
        pass


def test_a_scheduler_that_is_not_there_is_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CONNECT_SECONDS", 1.0)
    pytest.importorskip("distributed")
    with (
        pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9") as caught,
        open_runner("tcp://127.0.0.1:9", lambda line: None),
    ):
        pass
    assert "dask scheduler" in caught.value.hint


def test_a_scheduler_that_ends_leaves_resumable_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CONNECT_SECONDS", 1.0)
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as started,
        open_runner(started.scheduler_address, lambda line: None) as opened,
    ):
        results = opened.map(run_tasks.double, (Item(f"x{i}", {"x": i}) for i in range(10**6)))
        next(results)
        started.close()
        with pytest.raises(PartialError, match="the cluster is lost"):
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


def test_jobs_of_batch_systems(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a site needs comes beside what tasks need."""
    dask_jobqueue = pytest.importorskip("dask_jobqueue")
    scripts = []
    monkeypatch.setattr("shutil.which", lambda command: f"/usr/bin/{command}")
    for system in ("SLURMCluster", "PBSCluster"):
        monkeypatch.setattr(
            getattr(dask_jobqueue, system), "adapt", lambda self, **numbers: scripts.append(self.job_script())
        )
    own = {
        "job_script_prologue": ["module load python"],
        "worker_extra_args": ["--local-directory", "/scratch"],
        "queue": "short",
    }
    for name in ("slurm", "pbs"):
        config = ClusterConfig(
            engine=name,
            threads=8,
            gpus=1,
            memory=16e9,
            walltime=7200,
            options=own,  # type: ignore[arg-type]
        )
        with module._started(config, []):
            pass
    for script in scripts:
        lines = script.splitlines()
        assert lines.index("module load python") < lines.index(f"export {task.THREADS_VARIABLE}=8")
        assert "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False" in lines
        for words in (
            "--nthreads 1",
            "--preload mbtf_core.run.task",
            "--resources GPU=1",
            "--lifetime 6480s",
            "--local-directory /scratch",
        ):
            assert words in script
    assert "--cpus-per-task=8" in scripts[0]
    assert "-p short" in scripts[0]


def test_unknown_options_of_a_batch_system_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("dask_jobqueue")
    monkeypatch.setattr("shutil.which", lambda command: f"/usr/bin/{command}")
    file = tmp_path / "slurm.yaml"
    file.write_text("engine: slurm\noptions: {qeue: short}\n")
    with (
        pytest.raises(InputError, match="has no option 'qeue'"),
        open_runner(str(file), lambda line: None),
    ):
        pass


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
