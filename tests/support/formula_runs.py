"""Runs of the generator without tracing: values from a formula, and small configurations."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.engine.runtime import load_mitsuba
from mbtf_gen.planning.job import Job
from mbtf_gen.planning.run_plan import RunPlan, reference_plan
from support.datasets import formula

load_mitsuba()

from mbtf_core.data.documents import BadSample  # noqa: E402
from mbtf_gen.render.estimates import Estimates  # noqa: E402

SMALL = {
    "queries": {"train": "100", "test": "30", "spp": 2, "test_spp": 4},
    "output": {"shard_queries": 40},
}
FILES = ["train-00000.npz", "train-00001.npz", "train-00002.npz", "test-00000.npz"]


class Formula:
    """Replaces the estimator: values from a formula, and lists of the shards that it estimated."""

    def __init__(self) -> None:
        self.estimated: list[tuple[str, int]] = []
        self.lights: list[tuple[str, int]] = []
        self.fail_at: int | None = None
        self.bad = (BadSample(7, "direct light"),)
        self.more = 1

    def estimate(self, queries: Any, spp: int, stream: Any, *, lights: int = 1) -> Any:
        if self.fail_at == len(self.estimated):
            raise KeyboardInterrupt
        self.estimated.append((stream.split, stream.shard))
        self.lights.append((stream.split, lights))
        value = formula(queries).astype(np.float32)
        return Estimates(value, value, None, self.more * len(value) * spp, 1, 2, len(self.bad), self.bad)


def cheap_plan(job: Job, note: Callable[[str], None] = lambda phase: None) -> RunPlan:
    note("pilot paths")
    return RunPlan(reference_plan(job))


def changed(config: GeneratorConfig, **sections: dict[str, Any]) -> GeneratorConfig:
    data = config.model_dump()
    for name, section in sections.items():
        data[name] = {**data[name], **section} if isinstance(section, dict) else section
    return GeneratorConfig.model_validate(data)


def listing(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.suffix == ".npz"}
