"""One measurement of a cost study: what a configuration costs in time, and the error that it leaves."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json
from mbtf_core.digest import data_sha256
from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate

FORMAT = "mbtf-cost-measurement"
# Raised when the method of measuring changes: older measurements are then repeated.
SCHEMA = 6
FOLDER = "measurements"
# Relative half-width of a 95 % interval that a study aims at, and that half-width over the standard error.
HALF_WIDTH = 0.1
NORMAL = 1.96


@dataclass(frozen=True)
class Measurement:
    """A measured configuration.

    Attributes
    ----------
    study : the comparison that it belongs to
    series : its line in the plot of that comparison
    name : its name within the series
    options : of the configuration, by dotted name, as ``--set`` takes them
    command : reproduces it with the programs
    seconds : its time: per million queries for the generator; of generating in ``data``, of training in
        ``models``, of both with everything around them in ``whole``
    error : relative RMS error of the generator's values, or unexplained variance of a fit
    bias, noise : the two parts of the generator's error; error² = bias² + noise²
    details : further numbers by name: generation and training seconds, bytes, milliseconds
    """

    study: str
    series: str
    name: str
    options: dict[str, Any]
    command: str
    seconds: Estimate
    error: Estimate
    bias: Estimate | None = None
    noise: Estimate | None = None
    details: dict[str, float] = field(default_factory=dict)


_ESTIMATES = ("seconds", "error", "bias", "noise")


class MeasurementFolder:
    """Finished measurements, one file each, so that a study resumes where it stopped.

    Parameters
    ----------
    folder : of the study
    basis : what all measurements depend on: the hash of the material and the configuration, with its seed
    """

    def __init__(self, folder: Path, basis: dict[str, Any]) -> None:
        self.folder = folder / FOLDER
        self.basis = basis

    def _path(self, study: str, key: dict[str, Any]) -> Path:
        digest = data_sha256({"schema": SCHEMA, "basis": self.basis, "study": study, "key": key})
        return self.folder / f"{study}-{digest[:16]}.json"

    def get(self, study: str, key: dict[str, Any]) -> Measurement | None:
        """The stored measurement of a configuration; None where it is missing or its file is damaged."""
        path = self._path(study, key)
        if not path.exists():
            return None
        try:
            data = read_json(path)
            if data.pop("format") != FORMAT or data.pop("schema") != SCHEMA:
                return None
            data |= {name: e and estimate(e) for name in _ESTIMATES for e in (data[name],)}
            data["details"] = {k: math.nan if v is None else v for k, v in data["details"].items()}
            return Measurement(**data)
        except (InputError, KeyError, TypeError, AttributeError):
            return None

    def put(self, key: dict[str, Any], found: Measurement) -> None:
        """Store a measurement.

        Raises
        ------
        PartialError : the disk is full or the folder cannot be written
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        data = asdict(found) | {
            name: None if (e := getattr(found, name)) is None else e.as_dict() for name in _ESTIMATES
        }
        data["details"] = {k: v if math.isfinite(v) else None for k, v in found.details.items()}
        write_json(self._path(found.study, key), {"format": FORMAT, "schema": SCHEMA, **data})
