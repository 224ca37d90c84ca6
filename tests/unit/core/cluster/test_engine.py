"""Tasks on a local cluster: results, failures, and workers that die."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mbtf_core.cluster import engine, task
from mbtf_core.cluster.engine import Cluster, open_cluster
from mbtf_core.cluster.task import Task, run_task
from mbtf_core.errors import InputError, PartialError, UsageError

TASKS = "support.cluster_tasks"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="no Dask; to enable: pip install 'mbtf[cluster]'")
    with open_cluster("local:2", lambda line: None) as opened:
        assert opened is not None
        yield opened


def test_every_task_has_its_result(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_AHEAD", 3)
    tasks = (Task(f"double-{x}", f"{TASKS}:double", {"x": x}) for x in range(40))
    found = {done.task.arguments["x"]: done.value for done in cluster.run(tasks)}
    assert found == {x: 2 * x for x in range(40)}


def test_failures_are_one_line_and_leave_the_others(cluster: Cluster) -> None:
    kinds = ("partial", "bug")
    tasks = [Task(kind, f"{TASKS}:fail", {"kind": kind}) for kind in kinds]
    tasks.append(Task("double", f"{TASKS}:double", {"x": 4}))
    found = {done.task.name: done for done in cluster.run(tasks)}
    assert found["double"].value == 8
    assert found["partial"].error == "the disk is full"
    assert found["bug"].error == "ZeroDivisionError: a bug"


def test_bad_input_ends_the_run_unless_the_tasks_are_independent(cluster: Cluster) -> None:
    tasks = [Task("bad", f"{TASKS}:fail", {"kind": "input"})]
    with pytest.raises(InputError, match=r"bad on .*map.png: is not there"):
        list(cluster.run(tasks))
    (done,) = cluster.run(tasks, stop_when_fatal=False)
    assert done.error == "map.png: is not there"


def test_a_task_is_run_again_when_its_worker_dies(cluster: Cluster, tmp_path: Path) -> None:
    arguments = {"marks": str(tmp_path), "times": 2}
    (done,) = cluster.run([Task("dies", f"{TASKS}:die_at_first", arguments)])
    assert (done.value, done.error) == (3, "")


def test_workers_that_die_each_time_are_reported(cluster: Cluster) -> None:
    (done,) = cluster.run([Task("deadly", f"{TASKS}:fail", {"kind": "kill"})])
    assert "died each time" in done.error
    (after,) = cluster.run([Task("after", f"{TASKS}:double", {"x": 1})])
    assert after.value == 2


def test_workers_state_their_threads(cluster: Cluster) -> None:
    (done,) = cluster.run([Task("threads", f"{TASKS}:threads")])
    stated, environment = done.value
    assert stated is not None
    assert environment == str(stated)


def test_tasks_for_gpus_run_where_none_is_stated(cluster: Cluster) -> None:
    (done,) = cluster.run([Task("gpu", f"{TASKS}:double", {"x": 3}, gpu=True)])
    assert done.value == 6


def test_other_versions_are_refused() -> None:
    found = run_task(f"{TASKS}:double", {"x": 1}, "0.0.0")
    assert found["fatal"]
    assert "version" in found["error"]


def test_without_dask_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"mbtf\[cluster\]"), open_cluster("local", lambda line: None):
        pass


def test_a_scheduler_that_is_not_there_is_bad_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_CONNECT_SECONDS", 1.0)
    pytest.importorskip("distributed")
    with (
        pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9"),
        open_cluster("tcp://127.0.0.1:9", lambda line: None),
    ):
        pass


def test_a_scheduler_that_ends_leaves_resumable_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_CONNECT_SECONDS", 1.0)
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0"
        ) as started,
        open_cluster(started.scheduler_address, lambda line: None) as opened,
    ):
        assert opened is not None
        results = opened.run(Task(f"x{i}", f"{TASKS}:double", {"x": i}) for i in range(10**6))
        next(results)
        started.close()
        with pytest.raises(PartialError, match="the cluster is lost"):
            list(results)


def test_threads_outside_of_workers_are_unknown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(task.THREADS_VARIABLE, raising=False)
    assert task.worker_threads() is None
