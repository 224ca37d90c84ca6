"""The option ``--cluster``: what it names, the options of a cluster's workers, and their YAML file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveInt, field_validator, model_validator

from mbtf_core.config.settings import Settings, resolve
from mbtf_core.errors import UsageError
from mbtf_core.run.task import available_cores
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
    """Meaning of ``--cluster``; a UsageError where it is no cluster, an InputError where the file is at
    fault."""
    if match := re.fullmatch(r"local(?::([1-9]\d{0,3}))?", where):
        return local_config(None if match[1] is None else int(match[1]))
    if _ADDRESS.fullmatch(where):
        return ClusterConfig(address=where, start_timeout=60.0)
    path = Path(where)
    if path.suffix.lower() not in (".yaml", ".yml"):
        hint = "use local, local:4, a YAML file, or tcp://scheduler:8786"
        raise UsageError("is no cluster", where=f"--cluster {where}", hint=hint)
    return resolve(ClusterConfig, file=path)
