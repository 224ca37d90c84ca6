"""Workers as jobs of a batch system, by dask-jobqueue."""

from __future__ import annotations

import contextlib
import inspect
import re
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping
from typing import Any

from mbtf_core.errors import reason
from mbtf_core.run.workers import MEMORY, PRELOAD, ClusterConfig
from mbtf_core.suggest import suggest_name

# Class of dask-jobqueue, and the command that submits a job.
_SYSTEMS = {
    "slurm": ("SLURMCluster", "sbatch"),
    "pbs": ("PBSCluster", "qsub"),
    "sge": ("SGECluster", "qsub"),
    "lsf": ("LSFCluster", "bsub"),
    "oar": ("OARCluster", "oarsub"),
    "htcondor": ("HTCondorCluster", "condor_submit"),
}


@contextlib.contextmanager
def submitted_jobs(
    config: ClusterConfig, environment: Mapping[str, str], refused: list[str]
) -> Iterator[Any]:
    """Workers as jobs of a batch system, canceled when the block ends."""
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
        raise ValueError(_no_option(unknown[1], system)) from None
    try:
        # Unlike scale(), this replaces workers that have ended.
        cluster.adapt(minimum=config.workers, maximum=config.workers)
        yield cluster
    finally:
        # Jobs that were never submitted cannot be closed.
        with contextlib.suppress(Exception):
            cluster.close()


def _no_option(given: str, system: Any) -> str:
    """What is said of an option that a class of dask-jobqueue does not have."""
    classes = {*system.__mro__, *system.job_cls.__mro__}
    known = {name for cls in classes for name in inspect.signature(cls.__init__).parameters}
    parts = f"options: {system.__name__} has no option '{given}'", suggest_name(given, sorted(known))
    return "; ".join(filter(None, parts))


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
