"""A measured point of a cost study: what a setting costs, and the error that it leaves."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mbtf_core.atomic import read_json, write_json
from mbtf_core.digest import data_sha256
from mbtf_core.errors import InputError
from mbtf_core.stats import Estimate

POINT_FORMAT = "mbtf-cost-point"
# Half-width of a 95 % interval, relative, that a study aims at: measuring stops there.
HALF_WIDTH = 0.1
# That half-width over the standard error.
NORMAL = 1.96
# Raised when a point is measured in another way: what an earlier version measured is measured again.
POINT_SCHEMA = 5
POINTS = "points"


@dataclass(frozen=True)
class Point:
    """One setting, measured.

    Attributes
    ----------
    study : the trade that it is part of; series : the line it lies on; name : what tells it from the others
    setting : options by dotted name, as ``--set`` takes them
    command : does with the programs what was measured here
    seconds : what it costs: in the generator's studies per million queries, of ``data`` and ``seeds`` to
        generate, of ``fit`` to train, of ``chain`` in all
    error : what is wrong with the result, in the study's unit
    bias, noise : its two parts, where they are told apart; error² = bias² + noise²
    details : further numbers by name: generation and training seconds, bytes, milliseconds, …
    """

    study: str
    series: str
    name: str
    setting: dict[str, Any]
    command: str
    seconds: Estimate
    error: Estimate
    bias: Estimate | None = None
    noise: Estimate | None = None
    details: dict[str, float] = field(default_factory=dict)


_ESTIMATES = ("seconds", "error", "bias", "noise")


def _estimate(record: dict[str, Any] | None) -> Estimate | None:
    if record is None:
        return None
    value, error = (math.nan if record[k] is None else record[k] for k in ("value", "error"))
    return Estimate(value, math.inf if math.isnan(error) else error, record["n"])


class PointFolder:
    """Points that are done, one file each, so that a study goes on where it stopped.

    Parameters
    ----------
    folder : of the study
    basis : what all its points depend on: the material's and the configuration's hash, the seed
    """

    def __init__(self, folder: Path, basis: dict[str, Any]) -> None:
        self.folder = folder / POINTS
        self.basis = basis

    def _path(self, study: str, key: dict[str, Any]) -> Path:
        digest = data_sha256({"schema": POINT_SCHEMA, "basis": self.basis, "study": study, "key": key})
        return self.folder / f"{study}-{digest[:16]}.json"

    def get(self, study: str, key: dict[str, Any]) -> Point | None:
        """The point of a setting, where it has been measured; damaged files count as not measured."""
        path = self._path(study, key)
        if not path.exists():
            return None
        try:
            data = read_json(path)
            if data.pop("format") != POINT_FORMAT or data.pop("schema") != POINT_SCHEMA:
                return None
            data |= {name: _estimate(data[name]) for name in _ESTIMATES}
            data["details"] = {k: math.nan if v is None else v for k, v in data["details"].items()}
            return Point(**data)
        except (InputError, KeyError, TypeError, AttributeError):
            return None

    def put(self, key: dict[str, Any], point: Point) -> None:
        """Keep a point.

        Raises
        ------
        PartialError : the disk is full or the folder cannot be written
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        data = asdict(point) | {
            name: None if (e := getattr(point, name)) is None else e.as_dict() for name in _ESTIMATES
        }
        data["details"] = {k: v if math.isfinite(v) else None for k, v in point.details.items()}
        write_json(self._path(point.study, key), {"format": POINT_FORMAT, "schema": POINT_SCHEMA, **data})
