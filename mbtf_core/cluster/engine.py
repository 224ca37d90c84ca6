"""Runs tasks on Dask's workers: started here, by a batch system, or by the user.

Dask's scheduler hands a task to another worker when the first one dies. The tasks are idempotent, so that
neither a dead worker nor a dead command loses or doubles anything: the same command goes on from the files.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version
from typing import Any
from uuid import uuid4

from mbtf_core.cluster.config import ClusterConfig, read_cluster
from mbtf_core.cluster.task import THREADS_VARIABLE, Task, TaskResult, run_task
from mbtf_core.errors import InputError, PartialError, UsageError, reason
from mbtf_core.units import format_duration

# Tasks that the scheduler knows at a time, beyond those that run.
_AHEAD = 256
# Seconds in which a scheduler must answer.
_CONNECT_SECONDS = 30.0
_RESUMES = "the same command goes on with the rest"
_PRELOAD = "mbtf_core.cluster.task"
_CLASSES = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "oar": "OARCluster",
    "htcondor": "HTCondorCluster",
}


class Cluster:
    """Workers that run tasks; made by :func:`open_cluster`."""

    def __init__(self, client: Any, retries: int) -> None:
        self._client = client
        self._retries = retries

    @property
    def workers(self) -> int:
        """Number of workers that are there now."""
        return len(self._known())

    @property
    def _gpus(self) -> bool:
        """Whether workers state GPUs. A task that asks for one waits for ever where none does."""
        return any("GPU" in worker["resources"] for worker in self._known().values())

    def _known(self) -> dict[str, Any]:
        found: dict[str, Any] = self._client.scheduler_info(n_workers=-1)["workers"]
        return found

    def run(self, tasks: Iterable[Task], *, stop_when_fatal: bool = True) -> Iterator[TaskResult]:
        """Run tasks; yields each result as it comes, in no particular order.

        Parameters
        ----------
        tasks : iterable of Task
            Read as workers become free.
        stop_when_fatal : bool
            Whether a failure that concerns files or options concerns all tasks.

        Yields
        ------
        TaskResult
            A task that failed for a reason that another attempt may not meet has been tried again.

        Raises
        ------
        InputError
            A task failed for a reason that concerns all of them; the others are canceled.
        PartialError
            The scheduler cannot be reached any more.
        """
        from distributed import as_completed

        run, waiting = uuid4().hex[:8], iter(tasks)
        pending: dict[str, Task] = {}
        done = as_completed(loop=self._client.loop)
        expected, gpus = version("mbtf"), self._gpus

        def submit() -> None:
            for task in waiting:
                key = f"{task.name}-{run}"
                pending[key] = task
                future = self._client.submit(
                    run_task,
                    task.function,
                    dict(task.arguments),
                    expected,
                    key=key,
                    pure=False,
                    retries=self._retries,
                    resources={"GPU": 1} if task.gpu and gpus else None,
                )
                done.add(future)
                if len(pending) >= _AHEAD + 2 * self.workers:
                    return

        try:
            submit()
            while pending:
                future = next(done)
                task = pending.pop(future.key)
                result = _result(task, future)
                if result.fatal and stop_when_fatal:
                    hint = "files must lie at the same place on every machine"
                    raise InputError(result.error, where=f"{task.name} on {result.worker}", hint=hint)
                yield result
                submit()
        except (OSError, TimeoutError) as error:
            raise PartialError(f"the cluster is lost ({reason(error)})", hint=_RESUMES) from None
        finally:
            # What runs is finished by its worker, and found by the next command.
            with contextlib.suppress(Exception):
                self._client.cancel(list(done.futures))


def _result(task: Task, future: Any) -> TaskResult:
    from distributed import KilledWorker

    if future.status == "cancelled":
        raise OSError("the scheduler has ended")
    error = future.exception()
    if isinstance(error, KilledWorker):
        text = "its worker died each time: out of memory, killed, or crashed"
        return TaskResult(task, error=text)
    if error is not None:
        return TaskResult(task, error=f"{type(error).__name__}: {reason(error)}")
    return TaskResult(task, **future.result())


@contextlib.contextmanager
def open_cluster(where: str | None, note: Callable[[str], None]) -> Iterator[Cluster | None]:
    """Workers for the tasks of a block.

    Parameters
    ----------
    where : str or None
        ``local``, ``local:4``, a YAML file of :class:`~mbtf_core.cluster.config.ClusterConfig`, or the
        address of a scheduler; None yields None.
    note : callable
        Receives lines for the user.

    Yields
    ------
    Cluster or None

    Raises
    ------
    UsageError
        Dask is not installed, or `where` is none of these.
    InputError
        The batch system or the scheduler cannot be used.
    """
    if where is None:
        yield None
        return
    config = read_cluster(where)
    try:
        import dask
        from distributed import Client
    except ImportError:
        hint = "pip install 'mbtf[cluster]'"
        raise UsageError("Dask is not installed", where="--cluster", hint=hint) from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    settings = {
        # A worker that dies is started again; its task counts the deaths.
        "distributed.scheduler.allowed-failures": 5 if isinstance(config, str) else config.retries,
        "distributed.worker.multiprocessing-method": "spawn",
        # Results are small; workers take a task when they have a free thread.
        "distributed.scheduler.worker-saturation": 1.0,
        # A renderer's memory is not Dask's to spill; what exceeds the limit is restarted.
        "distributed.worker.memory.target": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.pause": False,
        "distributed.logging.distributed": "critical",
        "distributed.comm.timeouts.connect": f"{_CONNECT_SECONDS}s",
    }
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        try:
            address = config if isinstance(config, str) else stack.enter_context(_started(config))
            client = stack.enter_context(Client(address, timeout=_CONNECT_SECONDS, set_as_default=False))
        except (OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
            raise InputError(f"cannot be used ({reason(error)})", where=f"--cluster {where}") from None
        cluster = Cluster(client, 5 if isinstance(config, str) else config.retries)
        _wait(client, config, where)
        note(_describe(client, config, cluster))
        yield cluster


def _wait(client: Any, config: ClusterConfig | str, where: str) -> None:
    """Wait for the first worker."""
    seconds = 60.0 if isinstance(config, str) else config.start_timeout
    try:
        client.wait_for_workers(1, timeout=seconds)
    except TimeoutError:
        what = f"no worker has started within {format_duration(seconds)}"
        hint = "see the batch system's queue and logs; 'start_timeout' is the time to wait"
        raise InputError(what, where=f"--cluster {where}", hint=hint) from None


def _describe(client: Any, config: ClusterConfig | str, cluster: Cluster) -> str:
    if isinstance(config, str):
        text = f"cluster: {config}, {cluster.workers} workers"
    else:
        shape = f"{config.workers} worker{'s' * (config.workers > 1)} of {config.threads} thread"
        text = f"cluster: {config.engine}, {shape}{'s' * (config.threads > 1)}"
    try:
        import bokeh  # noqa: F401
    except ImportError:
        return text
    return f"{text}, dashboard {client.dashboard_link}"


def _started(config: ClusterConfig) -> Any:
    """A Dask cluster, which ends its workers when its block ends."""
    environment = {THREADS_VARIABLE: str(config.threads), "OMP_NUM_THREADS": str(config.threads)}
    resources = {"GPU": config.gpus} if config.gpus else {}
    if config.engine == "local":
        from distributed import LocalCluster

        return LocalCluster(
            n_workers=config.workers,
            # One task at a time, which has the threads.
            threads_per_worker=1,
            processes=True,
            memory_limit="auto" if config.memory is None else int(config.memory),
            dashboard_address="127.0.0.1:0",
            host="127.0.0.1",
            env=environment,
            resources=resources,
            preload=[_PRELOAD],
            silence_logs=logging.CRITICAL,
            **config.options,
        )
    import dask_jobqueue

    hours, rest = divmod(int(config.walltime), 3600)
    # One task at a time, which has the threads.
    extra = ["--nthreads", "1", "--preload", _PRELOAD]
    if resources:
        extra += ["--resources", f"GPU={config.gpus}"]
    # Workers end before the batch system ends them, one after the other.
    extra += ["--lifetime", f"{max(60, int(0.9 * config.walltime))}s", "--lifetime-stagger", "60s"]
    options: dict[str, Any] = {
        "cores": config.threads,
        "processes": 1,
        "memory": f"{int(config.memory or 4e9 * max(1, config.threads / 2))}B",
        "walltime": f"{hours:02d}:{rest // 60:02d}:{rest % 60:02d}",
        "worker_extra_args": extra,
        "log_directory": "worker-logs",
        "job_script_prologue": [f"export {name}={value}" for name, value in environment.items()],
        **config.options,
    }
    cluster = getattr(dask_jobqueue, _CLASSES[config.engine])(**options)
    # Unlike scale(), this replaces workers that have ended.
    cluster.adapt(minimum=config.workers, maximum=config.workers)
    return cluster
