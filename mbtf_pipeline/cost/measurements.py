"""One measurement of a cost study: what a configuration costs in time, and the error that it leaves."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.errors import InputError
from mbtf_core.files.atomic import data_sha256, read_json, write_json
from mbtf_core.stats import Estimate
from mbtf_pipeline.number_text import estimate

# Raised when the method of measuring changes: older measurements are then repeated.
SCHEMA = 7
FOLDER = "measurements"
# Relative half-width of a 95 % interval that a study aims at, and that half-width over the standard error.
HALF_WIDTH = 0.1
NORMAL = 1.96
# The comparisons of a study, in words.
COMPARISONS = {
    "whole": "complete run",
    "paths": "paths per query",
    "effects": "effects",
    "mesh": "mesh",
    "interactions": "surface interactions",
}
ESTIMATES = ("seconds", "error", "bias", "noise")


@dataclass(frozen=True)
class Configuration:
    """What is measured: the comparison that it belongs to, its line in the plot of that comparison (empty
    where there is only one), and its name on that line."""

    study: str
    series: str
    name: str

    @property
    def title(self) -> str:
        """Series and name."""
        return ", ".join(filter(None, (self.series, self.name)))

    @property
    def label(self) -> str:
        """Its name among all configurations."""
        return f"{COMPARISONS[self.study]}: {self.title}"

    @property
    def key(self) -> dict[str, Any]:
        """What its measurement depends on besides the study's basis."""
        raise NotImplementedError


@dataclass(frozen=True)
class Measurement(Configuration):
    """A measured configuration.

    Attributes
    ----------
    command : reproduces it with the programs
    seconds : its time: per million queries for the generator; of generating, training and everything
        around them for a run
    error : relative RMS error of the generator's values, or unexplained variance of a fit
    bias, noise : the two parts of the generator's error; error² = bias² + noise²
    details : further numbers by name: generation and training seconds, bytes, milliseconds
    """

    command: str
    seconds: Estimate
    error: Estimate
    bias: Estimate | None = None
    noise: Estimate | None = None
    details: dict[str, float] = field(default_factory=dict)


class MeasurementFolder:
    """Finished measurements, one file each, so that a study resumes where it stopped; `basis` is the hash of
    the material and the configuration with its seed."""

    def __init__(self, folder: Path, basis: str) -> None:
        self.folder = folder / FOLDER
        self.basis = basis

    def _path(self, task: Configuration) -> Path:
        key = {"schema": SCHEMA, "basis": self.basis, "study": task.study, "key": task.key}
        return self.folder / f"{task.study}-{data_sha256(key)[:16]}.json"

    def get(self, task: Configuration, command: str = "") -> Measurement | None:
        """The stored measurement of a configuration; None where it is missing or its file is damaged."""
        try:
            data = read_json(self._path(task))
            numbers = {name: data[name] and estimate(data[name]) for name in ESTIMATES}
            return Measurement(
                task.study, task.series, task.name, command, **numbers, details=data["details"]
            )
        except (InputError, KeyError, TypeError):
            return None

    def put(self, task: Configuration, found: Measurement) -> None:
        """Store a measurement."""
        self.folder.mkdir(parents=True, exist_ok=True)
        numbers = {name: e and e.as_dict() for name in ESTIMATES for e in (getattr(found, name),)}
        write_json(self._path(task), {"label": task.label, **numbers, "details": found.details})
