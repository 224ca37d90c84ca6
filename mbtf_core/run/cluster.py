"""Runs tasks on Dask's workers: started here, by a batch system, or by the user.

Dask's scheduler hands a task to another worker when the first one dies. The tasks are idempotent, so that
neither a dead worker nor a dead command loses or doubles anything: the same command goes on from the files.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from importlib.metadata import version
from typing import Any
from uuid import uuid4

from mbtf_core.errors import InputError, PartialError, reason
from mbtf_core.extras import extra_error, has_extra, import_extra
from mbtf_core.run.batch import site_preload, submitted_jobs
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import GPUS_VARIABLE, THREADS_VARIABLE, Item, Result, TaskFunction, packed, run_task
from mbtf_core.run.timeouts import NoAnswer, call_within
from mbtf_core.run.workers import MEMORY, ClusterConfig, read_cluster
from mbtf_core.units import format_duration

# Seconds in which a client of a silent scheduler closes.
_LAST_SECONDS = 1.0
# The same in which the workers of this machine end; Dask kills them after five.
_CLOSE_SECONDS = 20.0
# Tasks that the scheduler knows at a time, beyond those that run.
_AHEAD = 256
# Interval at which a result is waited for.
_POLL_SECONDS = 0.02
# Seconds between two looks at the workers.
_LOOK_SECONDS = 2.0
# The same until the first one has started.
_START_SECONDS = 0.1
# Seconds until the first look whether an answer can still be expected.
_ANSWER_SECONDS = 1.0
# A task whose files another process works on is tried at this interval, until locks of dead ones have ended.
_PAUSE_SECONDS, _LOCKED_SECONDS = 10.0, 420.0
_RESUMES = "the same command goes on with the rest"


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
        # Why nothing can be expected any more, as last seen.
        self._fault = ""
        self._watch = threading.Thread(target=self._observe, name="cluster", daemon=True)

    def close(self) -> None:
        """Stop to observe the workers, and leave the scheduler."""
        self._ended.set()
        with contextlib.suppress(Exception):
            self._client.close(timeout=_LAST_SECONDS if self._fault else self._config.timeout)

    def wait(self, where: str) -> None:
        """Wait for the first worker, and observe the workers from then on. An InputError that names the
        option of `where` if none has started within the time of the configuration, or the batch system
        refuses the jobs; an OSError where the scheduler does not answer."""
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
        scheduler = call_within(
            self._config.timeout, lambda: self._client.sync(self._client.scheduler.identity)
        )
        self.workers = len(scheduler["workers"])
        self._gpus = any("GPU" in worker["resources"] for worker in scheduler["workers"].values())

    def _observe(self) -> None:
        """Keep the number of workers; says when none is left."""
        alone, limit = 0.0, self._config.start_timeout
        while not self._ended.wait(_LOOK_SECONDS):
            before = self.workers
            try:
                self._look()
            except NoAnswer as error:
                self._fault = reason(error)
                continue
            except Exception:  # the tasks report it
                continue
            alone = 0.0 if self.workers else alone + _LOOK_SECONDS
            self._fault = f"no worker within {format_duration(limit)}" if alone > limit else ""
            if before and not self.workers and not self._ended.is_set():
                self._note(
                    f"cluster: no worker is left; waiting for new ones, at most {format_duration(limit)}"
                )

    def map(
        self,
        function: TaskFunction,
        items: Iterable[Item],
        *,
        independent: bool = False,
    ) -> Generator[Result]:
        """As of the base class, in no particular order.

        An item that failed for a reason that another attempt may not meet has been tried again: if its worker
        died, at once; if another process works on its files, until locks of dead processes on other machines
        have ended.
        """
        distributed = import_extra("distributed", "--cluster")
        run, waiting = uuid4().hex[:8], iter(items)
        pending: dict[str, Item] = {}
        done = distributed.as_completed(loop=self._client.loop)
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
                while len(pending) < _AHEAD + 2 * self.workers and (item := next(waiting, None)) is not None:
                    submit(item)
                if not pending:
                    return
                while not done.has_ready():
                    self._check()
                    time.sleep(_POLL_SECONDS)
                future = next(done)
                item = pending.pop(future.key)
                result = self._result(item, future)
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
                self._check()
                call_within(self._config.timeout, lambda: self._client.cancel(list(done.futures)))

    def _check(self) -> None:
        """An OSError where nothing can be expected any more."""
        if self._fault:
            raise OSError(self._fault)

    def _result(self, item: Item, future: Any) -> Result:
        """How the item of a future ended; an OSError where the scheduler has."""
        distributed = import_extra("distributed", "--cluster")
        if future.status == "cancelled":
            raise OSError("the scheduler has ended")
        try:
            error = self._answer(future.exception)
            if error is None:
                return Result(item.name, **self._answer(future.result))
        except distributed.KilledWorker as died:
            # A lost result was computed again.
            error = died
        if isinstance(error, distributed.KilledWorker):
            return Result(item.name, error="its worker died each time: out of memory, killed, or crashed")
        return Result(item.name, error=f"{type(error).__name__}: {reason(error)}")

    def _answer(self, ask: Callable[..., Any]) -> Any:
        """What a call of a future returns; it is computed again where its worker has died."""
        seconds = _ANSWER_SECONDS
        while True:
            try:
                return ask(timeout=seconds)
            except TimeoutError:
                self._check()
                seconds = min(2 * seconds, self._config.timeout)


@contextlib.contextmanager
def open_runner(
    where: str | None, note: Callable[[str], None], otherwise: Runner | None = None
) -> Iterator[Runner]:
    """A runner for the tasks of a block: on workers ``local``, ``local:4``, of a YAML file of
    :class:`~mbtf_core.run.workers.ClusterConfig`, or of the scheduler at an address; None for `otherwise`, by
    default this process. `note` receives lines for the user.

    Raises
    ------
    UsageError : Dask is not installed, or `where` is none of these
    InputError : the batch system or the scheduler cannot be used
    """
    if where is None:
        yield otherwise or Runner()
        return
    config = read_cluster(where)
    dask, distributed = (import_extra(name, f"--cluster {where}") for name in ("dask", "distributed"))
    if config.engine != "local" and config.address is None and not has_extra("dask_jobqueue"):
        raise extra_error("dask_jobqueue", f"--cluster {where}")
    names = [name for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    # Tornado prints the traceback of a job that cannot be submitted.
    for name in [*names, "tornado.application"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)
    settings: dict[str, Any] = {
        # A worker that dies is started again; its task counts the deaths.
        "distributed.scheduler.allowed-failures": config.retries,
        "distributed.worker.multiprocessing-method": "spawn",
        # Workers take a task when they have a free thread.
        "distributed.scheduler.worker-saturation": 1.0,
        **{f"distributed.worker.memory.{name}": value for name, value in MEMORY.items()},
        "distributed.logging.distributed": "critical",
    }
    if config.engine == "local":
        # Dask gives up a worker that takes longer to start again, without another in its place.
        settings["distributed.deploy.lost-worker-timeout"] = "1d"
    limit = format_duration(config.timeout)
    refused: list[str] = []
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        if config.address is not None:
            note(f"cluster: connecting to {config.address}, at most {limit}")
        try:
            started = config.address or stack.enter_context(_workers(config, refused))
            # Dask's own time limit leaves out the first answer; its error is the better one.
            client = call_within(
                config.timeout,
                lambda: distributed.Client(started, timeout=0.8 * config.timeout, set_as_default=False),
            )
            cluster = DaskRunner(client, config, note, refused)
            stack.callback(cluster.close)
            if config.engine != "local" or config.address is not None:
                until = format_duration(config.start_timeout)
                note(f"cluster: waiting for the first worker, at most {until}")
            cluster.wait(f"--cluster {where}")
        except (OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
            own = version("distributed")
            hint = f"start one with: dask scheduler, of Dask {own} as this command"
            if isinstance(error, NoAnswer):
                hint = "see whether it hangs; to wait longer, name a file with 'address' and 'timeout'"
            raise InputError(
                f"cannot be used ({reason(error)})",
                where=f"--cluster {where}",
                hint="" if config.address is None else hint,
            ) from None
        name = config.address or config.engine
        count = f"{cluster.workers} worker{'s' * (cluster.workers != 1)}"
        note(f"cluster: {name}, {count}{' so far' * (name != 'local')}, dashboard {client.dashboard_link}")
        yield cluster


def _workers(config: ClusterConfig, refused: list[str]) -> Any:
    """A Dask cluster, which ends its workers when its block ends."""
    environment = {THREADS_VARIABLE: str(config.threads), "OMP_NUM_THREADS": str(config.threads)}
    if config.engine != "local":
        return submitted_jobs(config, environment, refused)
    return _local_workers(config, environment)


@contextlib.contextmanager
def _local_workers(config: ClusterConfig, environment: dict[str, str]) -> Iterator[Any]:
    """A Dask cluster on this machine."""
    dask, distributed = (import_extra(name, "--cluster") for name in ("dask", "distributed"))
    everything = import_extra("distributed.system", "--cluster").MEMORY_LIMIT
    gpus = {GPUS_VARIABLE: str(config.gpus)} if config.gpus else {}
    cluster = distributed.LocalCluster(
        n_workers=config.workers,
        # One task at a time, which has the threads.
        threads_per_worker=1,
        processes=True,
        memory_limit=int(config.memory or everything / config.workers),
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
        env={**environment, **gpus},
        # Without ours, those of the user's configuration.
        resources={**dask.config.get("distributed.worker.resources"), "GPU": config.gpus}
        if config.gpus
        else None,
        preload=site_preload(),
        silence_logs=logging.CRITICAL,
        **config.options,
    )
    try:
        yield cluster
    finally:
        nannies = [*cluster.workers.values()]
        try:
            cluster.close(timeout=_CLOSE_SECONDS)
        except TimeoutError:
            # Dask before 2026.8 waits for ever for a worker that was killed while it was started again.
            cluster.shutdown_on_close = False
            own = {nanny.pid for nanny in nannies}
            for child in multiprocessing.active_children():
                if child.pid in own:
                    child.kill()
