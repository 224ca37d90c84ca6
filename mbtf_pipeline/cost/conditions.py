"""What a cost study measures, and where: its data, the time of each comparison, and the machine."""

from __future__ import annotations

import shlex
from pathlib import Path

from mbtf_core.run.task import worker_threads
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.job import Job
from mbtf_pipeline.cost.measurement import Conditions
from mbtf_pipeline.cost.runs import GENERATOR, LEAST_SECONDS
from mbtf_pipeline.stages import machine

CONFIG_NAME = "generate.yaml"
WORK = ".work"
# About as many configurations of the generator share its time.
_CONFIGURATIONS = 35


def study_config(config: GeneratorConfig, seed: int | None) -> GeneratorConfig:
    """A recipe's generator as its study uses it: without a target error, which would override the numbers of
    paths, and with shuffled queries that share no paths."""
    own = {"target_error": None, "layout": "shuffled", "lights_per_path": 1}
    queries = config.queries.model_copy(update=own)
    seeds = {} if seed is None else {"seed": seed}
    return config.model_copy(update={"queries": queries, **seeds})


def measuring_machine() -> dict[str, str]:
    """Record of the machine that runs it; a task."""
    found = machine()
    if (threads := worker_threads()) is not None:
        found["system"] += f", workers of {threads} thread{'s' * (threads != 1)}"
    return found


def generator_seconds(seconds: float) -> float:
    """Time for comparisons of the generator: a share of what a study has beyond the least that forecasts."""
    return GENERATOR * max(0.0, seconds - LEAST_SECONDS)


def conditions_of(job: Job, folder: Path, seconds: float) -> Conditions:
    """Conditions of the measurements of a study in a folder."""
    config = job.config
    return Conditions(
        config.model_dump_json(),
        config.hash(job.material.digests),
        folder / WORK,
        0.5 * GENERATOR * seconds / _CONFIGURATIONS,
        shlex.join(["mbtf-gen", config.material, "--config", str(folder / CONFIG_NAME)]),
    )
