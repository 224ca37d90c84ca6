"""Errors of predictions on a data set, free of the data's noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.directions import ELEVATION_BANDS
from mbtf_core.errors import InputError
from mbtf_core.lattice import Lattice
from mbtf_core.stats import (
    Estimate,
    by_group,
    elevation_groups,
    level_groups,
    noise_free_mse,
    signal_variance,
    unexplained_variance,
)
from mbtf_fit.data.images import HELD_OUT
from mbtf_fit.data.loader import SAMPLE, Partition, Queries, load_split, load_training
from mbtf_fit.material.transmittance_fit import TransmittanceError, has_holes, judge_transmittance
from mbtf_gen.dataset.reader import Dataset

if TYPE_CHECKING:
    from mbtf_fit.material.material import Material

Predict = Callable[[Queries], NDArray[np.float32]]


@dataclass(frozen=True)
class Errors:
    """Errors on a set of queries.

    Attributes
    ----------
    n : queries
    mse : mean squared error E[(p-a)(p-b)], without the noise of the data, in 1/sr²
    variance : of the data's values, without their noise, in 1/sr²
    unexplained : the former over the latter: 0 is perfect, 1 no better than the mean value
    """

    n: int
    mse: Estimate
    variance: Estimate
    unexplained: Estimate

    @classmethod
    def of(cls, prediction: NDArray[np.float32], a: NDArray[np.float32], b: NDArray[np.float32]) -> Errors:
        """Errors of predictions (n, 3) against both halves (n, 3)."""
        return cls(
            len(prediction),
            noise_free_mse(prediction, a, b),
            signal_variance(a, b),
            unexplained_variance(prediction, a, b),
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "n": self.n,
            "mse": self.mse.as_dict(),
            "variance": self.variance.as_dict(),
            "unexplained": self.unexplained.as_dict(),
        }


@dataclass(frozen=True)
class SplitErrors:
    """Errors on one split: overall, by level of detail, by elevation.

    Attributes
    ----------
    levels : nearest level → errors
    elevations : (lower, upper) edge of the cosine, of light or view, whichever is lower → errors
    """

    overall: Errors
    levels: dict[int, Errors]
    elevations: dict[tuple[float, float], Errors]

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            **self.overall.as_dict(),
            "levels": {str(level): errors.as_dict() for level, errors in self.levels.items()},
            "elevations": {f"{low:g}-{high:g}": e.as_dict() for (low, high), e in self.elevations.items()},
        }


def _grouped(labels: NDArray[np.int64], *arrays: NDArray[np.float32]) -> dict[int, Errors]:
    mse = by_group(noise_free_mse, labels, *arrays)
    unexplained = by_group(unexplained_variance, labels, *arrays)
    variance = by_group(signal_variance, labels, *arrays[1:])
    return {k: Errors(mse[k].n, mse[k], variance[k], unexplained[k]) for k in mse}


def split_errors(predict: Predict, queries: Queries, lattice: Lattice) -> SplitErrors | None:
    """Errors of a prediction on queries; None where there are none."""
    if len(queries) == 0:
        return None
    arrays = (predict(queries), queries.value_a, queries.value_b)
    levels = _grouped(level_groups(queries.sigma, lattice.finest), *arrays)
    bands = _grouped(elevation_groups(queries.omega_i, queries.omega_o), *arrays)
    edges = ELEVATION_BANDS
    return SplitErrors(
        Errors.of(*arrays), levels, {(edges[k], edges[k + 1]): errors for k, errors in bands.items()}
    )


def judge(predict: Predict, data: Dataset, partition: Partition) -> dict[str, SplitErrors]:
    """Errors of a prediction on ``test``, ``held_out_queries``, ``held_out_directions``, and on ``training``
    queries; a set without queries is left out.

    The last is what the fit made of data that it knows. It is free of their noise like the others, but a fit
    that follows the noise of its own data comes out better there than it is, by twice the covariance of
    prediction and noise: the distance to the held-out queries is what it overfits by.

    Raises
    ------
    InputError : a test shard is missing or damaged
    """
    parts: dict[str, Queries] = {}
    if "test" in data.splits and data.shards("test"):
        parts["test"] = load_split(data, "test")
    parts["held_out_queries"] = partition.held_out_queries
    parts["held_out_directions"] = partition.held_out_directions
    # Evaluating a neighborhood per query takes its time, and queries of a buffer have much in common.
    parts["training"] = partition.sample.take(
        slice(None, None, SAMPLE // HELD_OUT if data.layout == "image" else 1)
    )
    found = {name: split_errors(predict, queries, data.lattice) for name, queries in parts.items()}
    return {name: errors for name, errors in found.items() if errors is not None}


def foreign_inputs(material: Material, shards: str | Path) -> list[str]:
    """Roles of the inputs (height, base_color, …) that differ between a data set and the one that the material
    was trained on; empty where either does not say what it was made from.

    Raises
    ------
    InputError : shards missing or damaged
    """
    trained, given = material.description["data"].get("inputs"), Dataset.open(shards).manifest.get("inputs")
    if not trained or not given:
        return []
    return [role for role in sorted({*trained, *given}) if trained.get(role) != given.get(role)]


@dataclass(frozen=True)
class Evaluation:
    """Errors of a material on a data set.

    Attributes
    ----------
    values : set of queries → errors
    transmittance : the same of what passes through holes; None unless material and data have some
    """

    values: dict[str, SplitErrors]
    transmittance: dict[str, TransmittanceError] | None


def evaluate(material: Material, shards: str | Path) -> Evaluation:
    """Errors of a fitted material on the splits of a data set: ``test``, and what was held out of ``train``.

    The held-out queries are those that the material's own configuration keeps out; on another data set than
    the material was made from they are just queries. Either layout will do: a value depends on its query
    alone.

    Raises
    ------
    InputError : shards missing, damaged, or of another aspect
    """
    data = Dataset.open(shards)
    if data.lattice.aspect != material.lattice.aspect:
        raise InputError(
            f"its tile has the aspect {data.lattice.aspect:g}, the material's {material.lattice.aspect:g}",
            where=data.folder,
        )
    partition = load_training(data, material.config.held_out, material.config.seed, memory=None)
    through = None
    if material.holes is not None and has_holes(data):
        through = judge_transmittance(material.holes, data, partition.selection)
    return Evaluation(judge(material.predict, data, partition), through)
