"""Runs tasks in processes of this machine."""

from __future__ import annotations

import signal
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from queue import SimpleQueue

from mbtf_core.errors import InputError
from mbtf_core.run.child import end_children, run_child
from mbtf_core.run.runner import Runner
from mbtf_core.run.task import (
    THREADS_VARIABLE,
    Item,
    Result,
    TaskFunction,
    available_cores,
    packed,
    run_task_alone,
)


class Processes(Runner):
    """Runs items in processes of this machine, each in one of its own: a crash ends its item alone.

    Parameters
    ----------
    workers : number of items at a time; they divide the cores
    """

    here = False

    def __init__(self, workers: int = 1) -> None:
        self.workers = workers

    def takes_gpu(self, device: str) -> bool:
        """As of the base class; ``auto`` is a GPU where there is one."""
        return device != "cpu"

    def map(
        self,
        function: TaskFunction,
        items: Iterable[Item],
        *,
        independent: bool = False,
        ahead: int | None = None,
    ) -> Generator[Result]:
        """As of the base class."""
        free: SimpleQueue[int] = SimpleQueue()
        environment = {}
        for worker in range(self.workers):
            free.put(worker)
        if self.workers > 1:
            threads = str(max(1, available_cores() // self.workers))
            environment = {THREADS_VARIABLE: threads, "OMP_NUM_THREADS": threads}

        def run(item: Item) -> Result:
            worker = free.get()
            try:
                gpu = worker if item.gpu else None
                done = run_child(
                    run_task_alone.__module__,
                    run_task_alone.__name__,
                    *packed(function, item),
                    gpu,
                    environment=environment,
                    trial=False,
                )
            finally:
                free.put(worker)
            return Result(item.name, **(done.answers or {"error": done.fault}))

        with ThreadPoolExecutor(self.workers) as pool:
            futures = [pool.submit(run, item) for item in items]
            try:
                for future in as_completed(futures):
                    result = future.result()
                    if result.fatal and not independent:
                        raise InputError(result.error, where=result.name, hint=result.hint)
                    yield result
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                # The children store their work and exit.
                end_children(signal.SIGTERM)
                raise
