"""Workers of Dask as jobs of a batch system, with what its site needs.

dask-jobqueue writes and submits the jobs. Its options come from the ``--cluster`` file, then from Dask's own
configuration, such as ``~/.config/dask/jobqueue.yaml``. What tasks need is added to both.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import threading
from collections.abc import Iterator, Mapping
from typing import Any

from mbtf_core.errors import reason
from mbtf_core.extras import import_extra
from mbtf_core.run.timeouts import call_within
from mbtf_core.run.workers import MEMORY, PRELOAD, ClusterConfig

# Class of dask-jobqueue, and the command that submits a job.
_SYSTEMS = {
    "slurm": ("SLURMCluster", "sbatch"),
    "pbs": ("PBSCluster", "qsub"),
    "sge": ("SGECluster", "qsub"),
    "lsf": ("LSFCluster", "bsub"),
    "oar": ("OARCluster", "oarsub"),
    "htcondor": ("HTCondorCluster", "condor_submit"),
}
# Options whose values follow from keys of the file, and lists, to which ours are added.
_OURS = {"cores": "threads", "processes": "workers", "memory": "memory", "walltime": "walltime"}
_LISTS = ("worker_extra_args", "job_script_prologue")


def site_preload() -> list[str]:
    """Modules that a worker loads: those of Dask's configuration, and ours."""
    dask = import_extra("dask", "--cluster")
    found = dask.config.get("distributed.worker.preload", None) or []
    return [*([found] if isinstance(found, str) else found), PRELOAD]


def _site_options(engine: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a file, with the lists of Dask's configuration where it gives none; dask-jobqueue reads the
    rest of that itself. A ValueError where an option is a key of the file."""
    dask = import_extra("dask", "--cluster")
    given = {key: value for key, value in options.items() if value is not None}
    for key, ours in _OURS.items():
        if key in given:
            raise ValueError(f"options: '{key}' follows from '{ours}' of the file: give that")
    section = f"jobqueue.{given.get('config_name', engine)}"
    for name in _LISTS:
        found = given.get(name) or dask.config.get(f"{section}.{name}", None) or []
        given[name] = [found] if isinstance(found, str) else found
    return {"log_directory": dask.config.get(f"{section}.log-directory", None) or "worker-logs", **given}


@contextlib.contextmanager
def submitted_jobs(
    config: ClusterConfig, environment: Mapping[str, str], refused: list[str]
) -> Iterator[Any]:
    """A Dask cluster of jobs with these variables, which are canceled when the block ends. `refused` gets the
    reasons why jobs cannot be submitted; an OSError, TypeError or ValueError where the batch system or its
    options cannot be used."""
    handler = signal.getsignal(signal.SIGINT)
    dask_jobqueue = import_extra("dask_jobqueue", "--cluster")

    # Its import lets Ctrl-C end the program as if all were done.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, handler)

    name, command = _SYSTEMS[config.engine]
    if shutil.which(command) is None:
        raise OSError(f"this machine has no command {command}")
    hours, rest = divmod(int(config.walltime), 3600)
    # One task at a time, which has the threads.
    extra = ["--nthreads", "1", *(word for module in site_preload() for word in ("--preload", module))]
    if config.gpus:
        extra += ["--resources", f"GPU={config.gpus}"]
    # Workers end before the batch system ends them, one after the other.
    extra += ["--lifetime", f"{max(60, int(0.9 * config.walltime))}s", "--lifetime-stagger", "60s"]
    memory = {f"DASK_DISTRIBUTED__WORKER__MEMORY__{key.upper()}": str(v) for key, v in MEMORY.items()}
    exports = [f"export {key}={value}" for key, value in {**environment, **memory}.items()]
    system = getattr(dask_jobqueue, name)
    own = _site_options(config.engine, config.options)
    options: dict[str, Any] = {
        **own,
        "cores": config.threads,
        "processes": 1,
        "memory": f"{int(config.memory or 2e9 * config.threads)}B",
        "walltime": f"{hours:02d}:{rest // 60:02d}:{rest % 60:02d}",
        # What a site needs comes on top.
        "worker_extra_args": [*extra, *own["worker_extra_args"]],
        "job_script_prologue": [*own["job_script_prologue"], *exports],
    }
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
        # Jobs that were never submitted cannot be closed; the batch system may not answer.
        with contextlib.suppress(Exception):
            call_within(config.timeout, cluster.close)


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
