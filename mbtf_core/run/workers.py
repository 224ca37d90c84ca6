"""The option ``--cluster``: what it names, the options of its workers, and their jobs in a batch system.

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
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveInt, field_validator, model_validator

from mbtf_core.config.settings import Settings, resolve
from mbtf_core.errors import UsageError, reason
from mbtf_core.extras import import_extra
from mbtf_core.run.task import available_cores
from mbtf_core.timeouts import call_within
from mbtf_core.units import Duration, Size

Engine = Literal["local", "slurm", "pbs", "sge", "lsf", "oar", "htcondor"]
# Module that prepares a worker of Dask.
PRELOAD = "mbtf_core.run.task"
# A renderer's memory is not Dask's to spill; what exceeds the limit is restarted.
MEMORY = {"target": False, "spill": False, "pause": False}
# Cores that one renderer uses well; bytes that a worker takes at least.
_CORES_EACH, _LEAST_MEMORY = 4, 2e8
_ADDRESS = re.compile(r"(tcp|tls|ucx)://.+")
# What is ours of workers that the user has started.
_OF_SCHEDULERS = {"address", "retries", "timeout", "start_timeout"}


class ClusterConfig(Settings):
    """Workers of a cluster. None of this changes the data that they make."""

    engine: Engine = Field("local", description="what starts the workers: this machine, or a batch system")
    workers: PositiveInt = Field(2, description="number of workers, each a process with one task at a time")
    threads: PositiveInt = Field(1, description="threads of a worker")
    memory: Size | None = Field(
        None,
        ge=_LEAST_MEMORY,
        description="memory beyond which a worker is restarted; default: an equal share of this machine's, "
        "2 GB per thread of a batch system",
    )
    gpus: int = Field(0, ge=0, description="GPUs of a worker")
    walltime: Duration = Field(3600.0, gt=0, description="time after which a batch system ends a worker")
    retries: int = Field(
        5, ge=0, description="how often a task is started again after its worker died or failed"
    )
    start_timeout: Duration = Field(600.0, gt=0, description="time to wait for a worker while there is none")
    timeout: Duration = Field(30.0, gt=0, description="time in which the scheduler must answer")
    options: dict[str, Any] = Field(
        {}, description="further arguments of the dask-jobqueue class, such as queue and account"
    )
    address: str | None = Field(
        None,
        description="of a scheduler that you have started, such as tcp://scheduler:8786, with its workers",
    )

    @field_validator("address")
    @classmethod
    def _is_address(cls, address: str | None) -> str | None:
        if address is not None and _ADDRESS.fullmatch(address) is None:
            raise ValueError("must be such as tcp://scheduler:8786")
        return address

    @model_validator(mode="after")
    def _has_one_origin(self) -> ClusterConfig:
        others = sorted(self.model_fields_set - _OF_SCHEDULERS)
        if self.address is not None and others:
            raise ValueError(f"{', '.join(others)} cannot go with address, whose workers you have started")
        return self


def local_config(workers: int | None = None) -> ClusterConfig:
    """Workers on this machine that share its cores; by default one per four cores, and at least two."""
    cores = available_cores()
    count = max(2, cores // _CORES_EACH) if workers is None else workers
    return ClusterConfig(workers=count, threads=max(1, cores // count))


def read_cluster(where: str) -> ClusterConfig:
    """Meaning of ``--cluster``.

    Raises
    ------
    UsageError : it is no cluster
    InputError : the file is at fault
    """
    if match := re.fullmatch(r"local(?::([1-9]\d{0,3}))?", where):
        return local_config(None if match[1] is None else int(match[1]))
    if _ADDRESS.fullmatch(where):
        return ClusterConfig(address=where, start_timeout=60.0)
    path = Path(where)
    if path.suffix.lower() not in (".yaml", ".yml"):
        hint = "use local, local:4, a YAML file, or tcp://scheduler:8786"
        raise UsageError("is no cluster", where=f"--cluster {where}", hint=hint)
    return resolve(ClusterConfig, file=path)


# Class of dask-jobqueue, and the command that submits a job.
_SYSTEMS = {
    "slurm": ("SLURMCluster", "sbatch"),
    "pbs": ("PBSCluster", "qsub"),
    "sge": ("SGECluster", "qsub"),
    "lsf": ("LSFCluster", "bsub"),
    "oar": ("OARCluster", "oarsub"),
    "htcondor": ("HTCondorCluster", "condor_submit"),
}
# Options of several lines or words, to which those of the tasks are added.
_LISTS = ("job_script_prologue", "worker_extra_args")
# Options whose values follow from keys of the file.
_OURS = {"cores": "threads", "processes": "workers", "memory": "memory", "walltime": "walltime"}


def site_preload() -> list[str]:
    """Modules that a worker loads: those of Dask's configuration, and ours."""
    dask = import_extra("dask", "--cluster")
    found = dask.config.get("distributed.worker.preload", None) or []
    return [*([found] if isinstance(found, str) else found), PRELOAD]


def _completed(engine: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a file, with those of Dask's configuration that ours are added to.

    Raises
    ------
    ValueError : an option is a key of the file
    """
    for key in options.keys() & _OURS.keys():
        raise ValueError(f"options: '{key}' follows from '{_OURS[key]}' of the file: give that")
    dask = import_extra("dask", "--cluster")
    section = f"jobqueue.{options.get('config_name', engine)}"
    stated = {key: dask.config.get(f"{section}.{key}", None) or [] for key in _LISTS}
    logs = dask.config.get(f"{section}.log-directory", None) or "worker-logs"
    return {"log_directory": logs, **stated, **options}


@contextlib.contextmanager
def submitted_jobs(
    config: ClusterConfig, environment: Mapping[str, str], refused: list[str]
) -> Iterator[Any]:
    """A Dask cluster of jobs, which are canceled when the block ends.

    Parameters
    ----------
    config : of the jobs
    environment : variables of the workers
    refused : gets the reasons why jobs cannot be submitted

    Raises
    ------
    OSError, TypeError, ValueError : the batch system or its options cannot be used
    """
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
    own = _completed(config.engine, config.options)
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
