"""The option ``--cluster``: what it names, the options of a cluster's workers, and their YAML file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveInt

from mbtf_core.config.settings import Settings, resolve
from mbtf_core.errors import UsageError
from mbtf_core.run.task import available_cores
from mbtf_core.units import Duration, Size

Engine = Literal["local", "slurm", "pbs", "sge", "lsf", "oar", "htcondor"]
# Module that prepares a worker of Dask.
PRELOAD = "mbtf_core.run.task"
# A renderer's memory is not Dask's to spill; what exceeds the limit is restarted.
MEMORY = {"target": False, "spill": False, "pause": False}
# Cores that one renderer uses well.
_CORES_EACH = 4


class ClusterConfig(Settings):
    """Workers of a cluster. None of this changes the data that they make."""

    engine: Engine = Field("local", description="what starts the workers: this machine, or a batch system")
    workers: PositiveInt = Field(2, description="number of workers, each a process with one task at a time")
    threads: PositiveInt = Field(1, description="threads of a worker")
    memory: Size | None = Field(
        None,
        description="memory of a worker; one that exceeds it is restarted; default: an equal share of this "
        "machine's, or 2 GB per thread of a batch system",
    )
    gpus: int = Field(0, ge=0, description="GPUs of a worker")
    walltime: Duration = Field(3600.0, gt=0, description="time after which a batch system ends a worker")
    retries: int = Field(
        5, ge=0, description="how often a task is started again after its worker died or failed"
    )
    start_timeout: Duration = Field(600.0, gt=0, description="time to wait for the first worker")
    options: dict[str, Any] = Field(
        {}, description="further arguments of the dask-jobqueue class, such as queue and account"
    )


def local_config(workers: int | None = None) -> ClusterConfig:
    """Workers on this machine that share its cores; by default one per four cores, and at least two."""
    cores = available_cores()
    count = max(2, cores // _CORES_EACH) if workers is None else workers
    return ClusterConfig(workers=count, threads=max(1, cores // count))


def read_cluster(where: str) -> ClusterConfig | str:
    """Meaning of ``--cluster``: a configuration, or the address of a scheduler.

    Raises
    ------
    UsageError : it is none of these
    InputError : the file is at fault
    """
    if match := re.fullmatch(r"local(?::([1-9]\d{0,3}))?", where):
        return local_config(None if match[1] is None else int(match[1]))
    if re.fullmatch(r"(tcp|tls|ucx)://.+", where):
        return where
    path = Path(where)
    if path.suffix.lower() not in (".yaml", ".yml"):
        hint = "use local, local:4, a YAML file, or tcp://scheduler:8786"
        raise UsageError("is no cluster", where=f"--cluster {where}", hint=hint)
    return resolve(ClusterConfig, file=path)
