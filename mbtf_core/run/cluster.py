"""Runs tasks on Dask's workers: started here, by a batch system, or by the user.

Dask's scheduler hands a task to another worker when the first one dies. The tasks are idempotent, so that
neither a dead worker nor a dead command loses or doubles anything: the same command goes on from the files.
"""

from __future__ import annotations

import contextlib
import logging
import re
import shutil
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any
from uuid import uuid4

from mbtf_core.errors import InputError, PartialError, UsageError, reason
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import GPUS_VARIABLE, THREADS_VARIABLE, Item, Result, TaskFunction, packed, run_task
from mbtf_core.run.workers import MEMORY, PRELOAD, ClusterConfig, read_cluster
from mbtf_core.units import format_duration

# Tasks that the scheduler knows at a time, beyond those that run.
_AHEAD = 256
# Seconds between two looks at the workers.
_LOOK_SECONDS = 2.0
# The same until the first one has started.
_START_SECONDS = 0.1
# A task whose files another process works on is tried at this interval, until locks of dead ones have ended.
_PAUSE_SECONDS, _LOCKED_SECONDS = 10.0, 420.0
# Seconds in which a scheduler must answer.
_CONNECT_SECONDS = 30.0
_RESUMES = "the same command goes on with the rest"
# Class of dask-jobqueue, and the command that submits a job.
_SYSTEMS = {
    "slurm": ("SLURMCluster", "sbatch"),
    "pbs": ("PBSCluster", "qsub"),
    "sge": ("SGECluster", "qsub"),
    "lsf": ("LSFCluster", "bsub"),
    "oar": ("OARCluster", "oarsub"),
    "htcondor": ("HTCondorCluster", "condor_submit"),
}


class DaskRunner(Runner):
    """Runs items on workers of Dask; made by :func:`open_runner`."""

    here = False

    def __init__(
        self,
        client: Any,
        config: ClusterConfig,
        note: Callable[[str], None],
        refused: Sequence[str] = (),
    ) -> None:
        self.workers = 0
        # Why the batch system took no job; grows while they are submitted.
        self._refused = refused
        self._client, self._config, self._note = client, config, note
        # A task that asks for a GPU waits for ever where no worker states one.
        self._gpus = False
        self._ended = threading.Event()
        self._watch = threading.Thread(target=self._observe, name="cluster", daemon=True)

    def close(self) -> None:
        """Stop to observe the workers."""
        self._ended.set()

    def wait(self, where: str) -> None:
        """Wait for the first worker, and observe the workers from then on.

        Raises
        ------
        InputError : none has started within the time of the configuration, or the batch system refuses the
            jobs; names the option of `where`
        """
        limit = self._config.start_timeout
        until = time.monotonic() + limit
        self._look()
        while not self.workers:
            if self._refused:
                what = f"the batch system refuses the jobs ({self._refused[0]})"
                hint = "correct the options of the file, such as queue and account"
                raise InputError(what, where=where, hint=hint)
            if time.monotonic() > until:
                what = f"no worker has started within {format_duration(limit)}"
                hint = "see the batch system's queue and logs; 'start_timeout' is the time to wait"
                raise InputError(what, where=where, hint=hint)
            time.sleep(_START_SECONDS)
            self._look()
        self._watch.start()

    def _look(self) -> None:
        try:
            # Of all workers; older versions know no other answer.
            found = self._client.scheduler_info(n_workers=-1)["workers"]
        except TypeError:
            found = self._client.scheduler_info()["workers"]
        self.workers = len(found)
        self._gpus = any("GPU" in worker["resources"] for worker in found.values())

    def _observe(self) -> None:
        """Keep the number of workers; says when none is left."""
        while not self._ended.wait(_LOOK_SECONDS):
            before = self.workers
            try:
                self._look()
            except Exception:  # the tasks report it
                continue
            if before and not self.workers and not self._ended.is_set():
                self._note("cluster: no worker is left; waiting for new ones")

    def map(
        self,
        function: TaskFunction,
        items: Iterable[Item],
        *,
        independent: bool = False,
        ahead: int | None = None,
    ) -> Generator[Result]:
        """As of the base class, in no particular order.

        An item that failed for a reason that another attempt may not meet has been tried again: if its worker
        died, at once; if another process works on its files, until locks of dead processes on other machines
        have ended.
        """
        from distributed import as_completed

        run, waiting = uuid4().hex[:8], iter(items)
        most = _AHEAD if ahead is None else ahead
        pending: dict[str, Item] = {}
        done = as_completed(loop=self._client.loop)
        locked: deque[tuple[float, Item]] = deque()
        since: dict[str, float] = {}

        def submit(item: Item) -> None:
            key = f"{item.name}-{run}-{uuid4().hex[:4]}"
            pending[key] = item
            done.add(
                self._client.submit(
                    run_task,
                    *packed(function, item),
                    key=key,
                    pure=False,
                    retries=self._config.retries,
                    resources={"GPU": 1} if item.gpu and self._gpus else None,
                )
            )

        try:
            while True:
                while locked and (locked[0][0] <= time.monotonic() or not pending):
                    time.sleep(max(0.0, locked[0][0] - time.monotonic()))
                    submit(locked.popleft()[1])
                while len(pending) < most + 2 * self.workers and (item := next(waiting, None)) is not None:
                    submit(item)
                if not pending:
                    return
                future = next(done)
                item = pending.pop(future.key)
                result = _result(item, future)
                if result.fatal and not independent:
                    hint = result.hint or "files must lie at the same place on every machine"
                    raise InputError(result.error, where=f"{item.name} on {result.worker}", hint=hint)
                now = time.monotonic()
                if result.locked and now - since.setdefault(item.name, now) < _LOCKED_SECONDS:
                    locked.append((now + _PAUSE_SECONDS, item))
                    continue
                yield result
        except (OSError, TimeoutError) as error:
            raise PartialError(f"the cluster is lost ({reason(error)})", hint=_RESUMES) from None
        finally:
            # What runs is finished by its worker, and found by the next command.
            with contextlib.suppress(Exception):
                self._client.cancel(list(done.futures))


def _result(item: Item, future: Any) -> Result:
    from distributed import KilledWorker

    if future.status == "cancelled":
        raise OSError("the scheduler has ended")
    error = future.exception()
    if isinstance(error, KilledWorker):
        text = "its worker died each time: out of memory, killed, or crashed"
        return Result(item.name, error=text)
    if error is not None:
        return Result(item.name, error=f"{type(error).__name__}: {reason(error)}")
    return Result(item.name, **future.result())


@contextlib.contextmanager
def open_runner(
    where: str | None, note: Callable[[str], None], otherwise: Runner | None = None
) -> Iterator[Runner]:
    """A runner for the tasks of a block.

    Parameters
    ----------
    where : ``local``, ``local:4``, a YAML file of :class:`~mbtf_core.run.workers.ClusterConfig`, or the
        address of a scheduler; None for `otherwise`
    note : receives lines for the user
    otherwise : this process by default

    Raises
    ------
    UsageError : Dask is not installed, or `where` is none of these
    InputError : the batch system or the scheduler cannot be used
    """
    if where is None:
        yield otherwise or Runner()
        return
    with _open_workers(where, note) as workers:
        yield workers


@contextlib.contextmanager
def _open_workers(where: str, note: Callable[[str], None]) -> Iterator[DaskRunner]:
    """Workers for the tasks of a block; see :func:`open_runner`."""
    found = read_cluster(where)
    address = found if isinstance(found, str) else None
    # Of workers that the user has started, only retries and times are ours.
    config = ClusterConfig(start_timeout=60.0) if isinstance(found, str) else found
    try:
        import dask
        from distributed import Client
    except ImportError:
        hint = "pip install 'mbtf[cluster]'"
        raise UsageError("Dask is not installed", where="--cluster", hint=hint) from None
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    # Tornado prints the traceback of a job that cannot be submitted.
    for name in [*names, "tornado.application"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    settings = {
        # A worker that dies is started again; its task counts the deaths.
        "distributed.scheduler.allowed-failures": config.retries,
        "distributed.worker.multiprocessing-method": "spawn",
        # Workers take a task when they have a free thread.
        "distributed.scheduler.worker-saturation": 1.0,
        **{f"distributed.worker.memory.{name}": value for name, value in MEMORY.items()},
        "distributed.logging.distributed": "critical",
        "distributed.comm.timeouts.connect": f"{_CONNECT_SECONDS}s",
    }
    refused: list[str] = []
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        if address is not None:
            note(f"cluster: connecting to {address}, at most {_CONNECT_SECONDS:.0f} s")
        try:
            started = stack.enter_context(_started(config, refused)) if address is None else address
            client = stack.enter_context(Client(started, timeout=_CONNECT_SECONDS, set_as_default=False))
            cluster = DaskRunner(client, config, note, refused)
            stack.callback(cluster.close)
        except (OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
            own = version("distributed")
            hint = "" if address is None else f"start one with: dask scheduler, of Dask {own} as this command"
            raise InputError(
                f"cannot be used ({reason(error)})", where=f"--cluster {where}", hint=hint
            ) from None
        if config.engine != "local" or address is not None:
            note(f"cluster: waiting for the first worker, at most {format_duration(config.start_timeout)}")
        cluster.wait(f"--cluster {where}")
        name, count = address or config.engine, f"{cluster.workers} worker{'s' * (cluster.workers != 1)}"
        note(f"cluster: {name}, {count}{' so far' * (name != 'local')}, dashboard {client.dashboard_link}")
        yield cluster


def _started(config: ClusterConfig, refused: list[str]) -> Any:
    """A Dask cluster, which ends its workers when its block ends."""
    environment = {THREADS_VARIABLE: str(config.threads), "OMP_NUM_THREADS": str(config.threads)}
    if config.engine != "local":
        return _submitted_jobs(config, environment, refused)
    from distributed import LocalCluster
    from distributed.system import MEMORY_LIMIT

    gpus = {GPUS_VARIABLE: str(config.gpus)} if config.gpus else {}
    return LocalCluster(
        n_workers=config.workers,
        # One task at a time, which has the threads.
        threads_per_worker=1,
        processes=True,
        memory_limit=int(config.memory or MEMORY_LIMIT / config.workers),
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
        env={**environment, **gpus},
        resources={"GPU": config.gpus} if config.gpus else {},
        preload=[PRELOAD],
        silence_logs=logging.CRITICAL,
        **config.options,
    )


@contextlib.contextmanager
def _submitted_jobs(
    config: ClusterConfig, environment: Mapping[str, str], refused: list[str]
) -> Iterator[Any]:
    """Workers as jobs of a batch system, canceled when the block ends; `refused` gets the reasons why jobs
    cannot be submitted."""
    handler = signal.getsignal(signal.SIGINT)
    import dask_jobqueue

    # Its import lets Ctrl-C end the program as if all were done.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)

    name, command = _SYSTEMS[config.engine]
    if shutil.which(command) is None:
        raise OSError(f"this machine has no command {command}")
    hours, rest = divmod(int(config.walltime), 3600)
    # One task at a time, which has the threads.
    extra = ["--nthreads", "1", "--preload", PRELOAD]
    if config.gpus:
        extra += ["--resources", f"GPU={config.gpus}"]
    # Workers end before the batch system ends them, one after the other.
    extra += ["--lifetime", f"{max(60, int(0.9 * config.walltime))}s", "--lifetime-stagger", "60s"]
    memory = {f"DASK_DISTRIBUTED__WORKER__MEMORY__{key.upper()}": str(v) for key, v in MEMORY.items()}
    own = dict(config.options)
    exports = [f"export {key}={value}" for key, value in {**environment, **memory}.items()]
    options: dict[str, Any] = {
        "cores": config.threads,
        "processes": 1,
        "memory": f"{int(config.memory or 2e9 * config.threads)}B",
        "walltime": f"{hours:02d}:{rest // 60:02d}:{rest % 60:02d}",
        # What a site needs comes on top.
        "worker_extra_args": [*extra, *own.pop("worker_extra_args", [])],
        "job_script_prologue": [*own.pop("job_script_prologue", []), *exports],
        "log_directory": "worker-logs",
        **own,
    }
    system = getattr(dask_jobqueue, name)
    try:
        cluster = system(job_cls=_reporting(system.job_cls, refused), **options)
    except (TypeError, ValueError) as error:
        # Its text goes on with all the options.
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        if unknown is None:
            raise
        raise ValueError(f"options: {name} has no option '{unknown[1]}'") from None
    try:
        # Unlike scale(), this replaces workers that have ended.
        cluster.adapt(minimum=config.workers, maximum=config.workers)
        yield cluster
    finally:
        # Jobs that were never submitted cannot be closed.
        with contextlib.suppress(Exception):
            cluster.close()


def _reporting(job: Any, refused: list[str]) -> Any:
    """A class of jobs that also reports why one cannot be submitted."""

    class Reporting(job):
        async def start(self) -> None:
            try:
                await super().start()
            except Exception as error:
                # dask-jobqueue appends what the command has printed.
                refused.append(reason(str(error).rpartition("stderr:")[2], 300))
                raise

    return Reporting
