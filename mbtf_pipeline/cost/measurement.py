"""What a cost study measures: configurations, time and error of each, the files that keep them, and what
follows: error bars of seeds, the Pareto front."""

from __future__ import annotations

import math
import shlex
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, read_json, write_json
from mbtf_core.stats import Estimate, mean_estimate
from mbtf_gen.config.generator import GeneratorConfig
from mbtf_gen.planning.job import Job
from mbtf_pipeline.tables import estimate

# Raised when the method of measuring changes: older measurements are then repeated.
SCHEMA = 12
# In the folder of a study: measurements, the generator's configuration, and temporary data and fits.
FOLDER, CONFIG_NAME, WORK = "measurements", "generate.yaml", ".work"
# About as many configurations of the generator share its time.
_CONFIGURATIONS = 35
ESTIMATES = ("seconds", "error", "bias", "noise")
# Relative standard deviation of a run over seeds before any run is repeated, and the degrees of freedom that
# it counts for: studies of four materials found 1.5 to 6% (docs/how-to/measure-cost.md).
PRIOR, PRIOR_DEGREES = 0.05, 4


@dataclass(frozen=True)
class Conditions:
    """What all measurements of a study share.

    Attributes
    ----------
    config_json : the generator's configuration; basis : hash of it and of the material
    folder : of temporary data and fits
    seconds : time for noise and bias of a configuration of the generator, each
    command : of the generator with this configuration
    """

    config_json: str
    basis: str
    folder: Path
    seconds: float
    command: str

    @classmethod
    def of(cls, job: Job, folder: Path, seconds: float) -> Conditions:
        """Of a study in a folder, whose comparisons of the generator take about so many seconds."""
        config = job.config
        command = shlex.join(["mbtf-gen", config.material, "--config", str(folder / CONFIG_NAME)])
        basis, each = config.hash(job.material.digests), 0.5 * seconds / _CONFIGURATIONS
        return cls(config.model_dump_json(), basis, folder / WORK, each, command)

    @cached_property
    def config(self) -> GeneratorConfig:
        """The generator's configuration."""
        return GeneratorConfig.model_validate_json(self.config_json)


@dataclass(frozen=True)
class Configuration:
    """What is measured: the comparison that it belongs to (``run``, or a part of the generator), its line in
    the plot of that comparison (empty where there is only one), and its name on that line."""

    study: str
    series: str
    name: str

    @property
    def label(self) -> str:
        """Its name among all configurations."""
        return ", ".join(filter(None, (self.study, self.series, self.name)))

    @property
    def folder(self) -> str:
        """Folder that its command writes to: no two configurations of a study share one."""
        return f"{self.study.replace(' ', '-')}-{data_sha256(self.key)[:6]}"

    @property
    def key(self) -> dict[str, Any]:
        """What its measurement depends on besides the study's conditions."""
        raise NotImplementedError

    def command(self, conditions: Conditions) -> str:
        """Reproduces it with the programs."""
        raise NotImplementedError

    def measure(self, conditions: Conditions) -> Measurement:
        """Measure it in this process."""
        raise NotImplementedError


@dataclass(frozen=True)
class Measurement:
    """A measured configuration.

    Attributes
    ----------
    study, series, name : of the configuration
    command : reproduces it with the programs
    seconds : its time: per million queries for the generator; of generating, training and everything
        around them for a run.
    error : relative RMS error of the generator's values, or unexplained variance of a fit
    bias, noise : the two parts of the generator's error; error² = bias² + noise²
    details : further numbers by name: generation and training seconds, bytes, milliseconds
    """

    study: str
    series: str
    name: str
    command: str
    seconds: Estimate
    error: Estimate
    bias: Estimate | None = None
    noise: Estimate | None = None
    details: dict[str, float] = field(default_factory=dict)


class MeasurementFolder:
    """Finished measurements, one file each, so that a study resumes where it stopped."""

    def __init__(self, folder: Path, conditions: Conditions) -> None:
        self.folder, self.conditions = folder / FOLDER, conditions

    def _path(self, of: Configuration) -> Path:
        key = {"schema": SCHEMA, "basis": self.conditions.basis, "study": of.study, "key": of.key}
        return self.folder / f"{of.study}-{data_sha256(key)[:16]}.json"

    def get(self, of: Configuration) -> Measurement | None:
        """The stored measurement of a configuration; None where it is missing or its file is damaged."""
        try:
            data = read_json(self._path(of))
            numbers = {name: data[name] and estimate(data[name]) for name in ESTIMATES}
            command = of.command(self.conditions)
            return Measurement(of.study, of.series, of.name, command, **numbers, details=data["details"])
        except (InputError, KeyError, TypeError):
            return None

    def put(self, of: Configuration, found: Measurement) -> None:
        """Store a measurement."""
        self.folder.mkdir(parents=True, exist_ok=True)
        numbers = {name: e and e.as_dict() for name in ESTIMATES for e in (getattr(found, name),)}
        write_json(self._path(of), {"label": of.label, **numbers, "details": found.details})


def seed_deviation(groups: Iterable[Sequence[Measurement]]) -> Estimate:
    """Relative standard deviation of the error over seeds, pooled over configurations and the prior with
    their degrees of freedom; each group holds the runs of one configuration."""
    squares, degrees = PRIOR_DEGREES * PRIOR**2, PRIOR_DEGREES
    for group in groups:
        errors = [m.error.value for m in group if m.error.value > 0]
        if len(errors) > 1:
            squares += (len(errors) - 1) * statistics.variance(errors) / statistics.fmean(errors) ** 2
            degrees += len(errors) - 1
    value = math.sqrt(squares / degrees)
    return Estimate(value, value / math.sqrt(2 * degrees), degrees, degrees)


def combined(group: Sequence[Measurement], deviation: Estimate) -> Measurement:
    """The runs of one configuration as one measurement: name and command of the first one, means of
    all. The error by the test set is common to all runs, and does not become less by repeats."""
    error = statistics.fmean(m.error.value for m in group)
    spread = deviation.value * error / math.sqrt(len(group))
    test = statistics.fmean(m.error.error for m in group)
    details = {k: statistics.fmean(m.details[k] for m in group) for k in group[0].details}
    return replace(
        group[0],
        seconds=mean_estimate([m.seconds.value for m in group]),
        error=Estimate(error, math.hypot(spread, test), group[0].error.n),
        details={
            **details,
            "seeds": float(len(group)),
            "test_error": test / error if error > 0 else math.inf,
        },
    )


def pareto_front(found: Sequence[Measurement]) -> list[Measurement]:
    """Complete runs that no other one beats in both time and error, by increasing time.

    Compares the measured values. Of measurements whose error bars overlap, the cheaper one may be on the
    front by chance.
    """
    runs = [m for m in found if m.study == "run"]
    usable = [m for m in runs if math.isfinite(m.seconds.value) and math.isfinite(m.error.value)]
    front: list[Measurement] = []
    for m in sorted(usable, key=lambda m: (m.seconds.value, m.error.value)):
        if not front or m.error.value < front[-1].error.value:
            front.append(m)
    return front
