"""Errors of predictions on a data set, without the bias of the data's noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import ELEVATION_BANDS
from mbtf_core.errors import InputError
from mbtf_core.exposure import auto_exposure, brightness, white_of
from mbtf_core.stats import (
    Estimate,
    by_group,
    elevation_groups,
    level_groups,
    noise_free_mse,
    psnr,
    signal_variance,
    unexplained_variance,
)
from mbtf_fit.data.loader import MAX_HELD_OUT_OF_IMAGES, SAMPLE, Partition, load_split, load_training
from mbtf_fit.data.queries import ShardQueries, mean_value
from mbtf_fit.formatting import visibility
from mbtf_fit.material.transmittance import TransmittanceError, evaluate_transmittance, has_transmittance

if TYPE_CHECKING:
    from mbtf_fit.material.material import Material

Predict = Callable[[ShardQueries], NDArray[np.float32]]


@dataclass(frozen=True)
class Errors:
    """Errors on a set of queries.

    Attributes
    ----------
    n : int
        Number of queries.
    mse : Estimate
        Mean squared error E[(p-a)(p-b)] without the noise of the data, in 1/sr².
    variance : Estimate
        Variance of the data's values without their noise, in 1/sr².
    unexplained : Estimate
        Unexplained variance mse / variance (1 - R²): 0 is exact, 1 as good as the mean value.
    """

    n: int
    mse: Estimate
    variance: Estimate
    unexplained: Estimate

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        estimates = ("mse", "variance", "unexplained")
        return {"n": self.n, **{name: getattr(self, name).as_dict() for name in estimates}}


@dataclass(frozen=True)
class SplitErrors:
    """Errors on one split: overall, by level, by elevation.

    Attributes
    ----------
    overall : Errors
        Of all queries.
    levels : dict
        Nearest level → errors.
    elevations : dict
        (lower, upper) edge of the smaller cosine of light and view → errors.
    exposure : float
        Exposure in EV that displays the values, see :mod:`mbtf_core.exposure`.
    includes_noise : bool
        Whether the errors include the noise of the data, which have a single value per query.
    """

    overall: Errors
    levels: dict[int, Errors]
    elevations: dict[tuple[float, float], Errors]
    exposure: float
    includes_noise: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON; the peak of the PSNR is the value that the exposure shows as white."""
        found = {"mse": self.overall.mse.as_dict(), "exposure": self.exposure}
        return {
            **self.overall.as_dict(),
            "exposure": self.exposure,
            "psnr": psnr(self.overall.mse, white_of(self.exposure)).as_dict(),
            "visibility": visibility(found)[1],
            "includes_noise": self.includes_noise,
            "levels": {str(level): errors.as_dict() for level, errors in self.levels.items()},
            "elevations": {f"{low:g}-{high:g}": e.as_dict() for (low, high), e in self.elevations.items()},
        }


def _grouped(labels: NDArray[np.int64], *arrays: NDArray[np.float32]) -> dict[int, Errors]:
    mse = by_group(noise_free_mse, labels, *arrays)
    unexplained = by_group(unexplained_variance, labels, *arrays)
    variance = by_group(signal_variance, labels, *arrays[1:])
    return {k: Errors(mse[k].n, mse[k], variance[k], unexplained[k]) for k in mse}


def exposure_of(queries: ShardQueries) -> float:
    """Automatic exposure in EV of the values of queries."""
    return auto_exposure([brightness(mean_value(queries.value_a, queries.value_b))])


def split_errors(
    predict: Predict, queries: ShardQueries, lattice: Lattice, exposure: float | None = None
) -> SplitErrors | None:
    """Errors of a prediction on queries, at an exposure in EV (by default, their own); None where there are
    none."""
    if len(queries) == 0:
        return None
    exposure = exposure_of(queries) if exposure is None else exposure
    arrays = predict(queries), queries.value_a, queries.value_b
    overall = noise_free_mse(*arrays), signal_variance(*arrays[1:]), unexplained_variance(*arrays)
    levels = _grouped(level_groups(queries.sigma, lattice.finest), *arrays)
    bands = _grouped(elevation_groups(queries.omega_i, queries.omega_o), *arrays)
    elevations = {(ELEVATION_BANDS[k], ELEVATION_BANDS[k + 1]): errors for k, errors in bands.items()}
    return SplitErrors(Errors(len(queries), *overall), levels, elevations, exposure)


def evaluate_splits(predict: Predict, data: Dataset, partition: Partition) -> dict[str, SplitErrors]:
    """Errors of a prediction on ``test``, ``held_out_queries``, ``held_out_directions`` and ``training``
    queries; a set without queries is left out. The exposure of all is that of the first.

    The error on training queries is underestimated by twice the covariance of prediction and noise: its
    distance from the error on held-out queries measures overfitting.
    """
    parts: dict[str, ShardQueries] = {}
    if "test" in data.splits and data.shards("test"):
        parts["test"] = load_split(data, "test")
    parts["held_out_queries"] = partition.held_out_queries
    parts["held_out_directions"] = partition.held_out_directions
    # The inception decoder is slow, and queries of one image are correlated.
    parts["training"] = partition.sample.take(
        slice(None, None, SAMPLE // MAX_HELD_OUT_OF_IMAGES if data.layout == "image" else 1)
    )
    parts = {name: queries for name, queries in parts.items() if len(queries)}
    exposure = exposure_of(next(iter(parts.values()))) if parts else None
    found = {name: split_errors(predict, queries, data.lattice, exposure) for name, queries in parts.items()}
    noisy = data.estimates == 1
    return {
        name: replace(errors, includes_noise=noisy) for name, errors in found.items() if errors is not None
    }


def foreign_inputs(material: Material, shards: str | Path | DataFolder) -> list[str]:
    """Inputs (height, base_color, …) that differ between a data set and the training data of a material;
    empty where either records none."""
    trained, given = material.description["data"].get("inputs"), Dataset.open(shards).manifest.get("inputs")
    if not trained or not given:
        return []
    return [role for role in sorted({*trained, *given}) if trained.get(role) != given.get(role)]


@dataclass(frozen=True)
class Evaluation:
    """Errors of a material on a data set.

    Attributes
    ----------
    values : dict
        Split → :class:`SplitErrors` of the values.
    transmittance : dict or None
        Split → error of the transmittance; None unless both material and data have one.
    """

    values: dict[str, SplitErrors]
    transmittance: dict[str, TransmittanceError] | None


def evaluate(material: Material, shards: str | Path | DataFolder) -> Evaluation:
    """Evaluate a fitted material on a data set of either layout.

    Held-out queries are selected by the material's own configuration; they are held out only in the data set
    that the material was fitted to.

    Parameters
    ----------
    material : Material
        The fitted material.
    shards : str or Path
        Folder made by ``mbtf-gen``.

    Returns
    -------
    Evaluation
        Errors of values and transmittance on the splits ``test``, ``held_out_queries``,
        ``held_out_directions`` and ``training``.

    Raises
    ------
    InputError
        Shards are missing, corrupt, or of another aspect ratio.
    """
    data = Dataset.open(shards)
    if data.lattice.aspect != material.lattice.aspect:
        raise InputError(
            f"its tile has the aspect {data.lattice.aspect:g}, the material's {material.lattice.aspect:g}",
            where=data.folder,
        )
    partition = load_training(data, material.config.held_out, material.config.seed, memory=None)
    transmittance = None
    if material.transmittance is not None and has_transmittance(data):
        transmittance = evaluate_transmittance(material.transmittance, data, partition.selection)
    return Evaluation(evaluate_splits(material.predict, data, partition), transmittance)
