"""Errors of predictions on a data set, without the bias of the data's noise."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import auto_exposure, brightness, white_of
from mbtf_core.data.dataset import Dataset
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.directions import ELEVATION_BANDS
from mbtf_core.errors import InputError
from mbtf_core.paths import opened
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
from mbtf_fit.material.transmittance import evaluate_transmittance, has_transmittance

if TYPE_CHECKING:
    from mbtf_fit.material.material import Material

F32 = NDArray[np.float32]
# Outliers make up this share of an error each, and are off by so many standard errors of the reference.
_OUTLYING, _OFF = 0.05, 4.0
Predict = Callable[[ShardQueries], F32]


def exposure_of(queries: ShardQueries) -> float:
    """Automatic exposure in EV of the values of queries."""
    values = mean_value(queries.value_a, queries.value_b)
    return auto_exposure([brightness(values, queries.weight)])


def split_errors(
    predict: Predict, queries: ShardQueries, data: Dataset, exposure: float | None = None
) -> dict[str, Any]:
    """Errors of a prediction on queries of a data set, without the noise of the data.

    Parameters
    ----------
    predict : values (n, 3) of queries
    queries : ShardQueries
    data : Dataset
    exposure : in EV, see :mod:`mbtf_core.color`; by default that of the queries

    Returns
    -------
    dict
        Plain data for JSON. ``mse`` E[(p-a)(p-b)] and ``variance`` of the values, in 1/sr², and their ratio
        ``unexplained`` (1 - R²: 0 is exact, 1 as good as the mean value), each an estimate with ``value``,
        ``error`` and ``n``, also by nearest level (``levels``) and by band of the smaller cosine of light and
        view (``elevations``); ``color``: what is unexplained of the differences between channels, and their
        ``share`` of the variance; ``ten_largest``: share of the ten largest squared errors in their sum;
        ``outliers``: those that noise does not explain, and where the first is; ``psnr``: its peak is the
        value that the exposure shows as white; ``visibility``: in words; ``includes_noise``: whether the data
        have one value per query.
    """
    exposure = exposure_of(queries) if exposure is None else exposure
    arrays = predict(queries), *queries.halves
    mse = noise_free_mse(*arrays)
    colors = _color(queries.value_a), _color(queries.value_b), queries.weight, queries.group
    variance, of_colors = signal_variance(*arrays[1:]), signal_variance(*colors).value
    found = {
        **_errors(len(queries), mse, variance, unexplained_variance(*arrays)),
        "color": unexplained_variance(_color(arrays[0]), *colors).as_dict()
        | {"share": of_colors / variance.value if variance.value > 0 else 0.0},
        "exposure": exposure,
        **_largest_errors(arrays[0], queries),
    }
    bands = _grouped(elevation_groups(queries.omega_i, queries.omega_o), *arrays)
    return {
        **found,
        "psnr": psnr(mse, white_of(exposure)).as_dict(),
        "visibility": visibility(found)[1],
        "includes_noise": data.estimates == 1,
        "levels": {
            str(level): errors
            for level, errors in _grouped(level_groups(queries.sigma, data.lattice.finest), *arrays).items()
        },
        "elevations": {
            f"{ELEVATION_BANDS[k]:g}-{ELEVATION_BANDS[k + 1]:g}": errors for k, errors in bands.items()
        },
    }


def _color(values: F32) -> F32:
    """Differences between channels: their mean square over that of other values is that of deviations from
    the mean, and they are exactly 0 for gray."""
    return values - np.roll(values, 1, axis=-1)


def _largest_errors(prediction: F32, queries: ShardQueries) -> dict[str, Any]:
    """Share of the ten largest squared errors in their sum; and the outliers among them, or None: predictions
    that noise does not explain. Values (1/sr) are means of the channels."""
    value, noise = mean_value(queries.value_a, queries.value_b), 0.5 * (queries.value_a - queries.value_b)
    squared, reference = (
        np.square(x, dtype=np.float64).reshape(len(x), -1).mean(axis=1) for x in (prediction - value, noise)
    )
    product = (squared - reference) * (1.0 if queries.weight is None else queries.weight)
    if not (total := float(product.sum())) > 0:
        return {"ten_largest": None, "outliers": None}
    largest = np.argsort(product)[:-11:-1]
    share = product[largest] / total
    off = (squared > _OFF**2 * reference)[largest] & (share > _OUTLYING)
    if not off.any() or prediction.ndim > 2:
        return {"ten_largest": float(share.sum()), "outliers": None}
    first = largest[off][0]
    z = queries.omega_i[first, 2], queries.omega_o[first, 2]
    outliers = {
        "n": int(off.sum()),
        "share": float(share[off].sum()),
        "predicted": float(prediction[first].mean()),
        "value": float(value[first].mean()),
        "level": float(level_of_sigma(queries.sigma[first])),
        "elevations": np.degrees(np.arcsin(np.minimum(z, 1.0))).tolist(),
        "u": queries.u[first].tolist(),
    }
    return {"ten_largest": float(share.sum()), "outliers": outliers}


def _errors(n: int, mse: Estimate, variance: Estimate, unexplained: Estimate) -> dict[str, Any]:
    return {
        "n": n,
        "mse": mse.as_dict(),
        "variance": variance.as_dict(),
        "unexplained": unexplained.as_dict(),
    }


def _grouped(labels: NDArray[np.int64], *arrays: NDArray[Any] | None) -> dict[int, dict[str, Any]]:
    mse = by_group(noise_free_mse, labels, *arrays)
    unexplained = by_group(unexplained_variance, labels, *arrays)
    variance = by_group(signal_variance, labels, *arrays[1:])
    return {k: _errors(int((labels == k).sum()), mse[k], variance[k], unexplained[k]) for k in mse}


def evaluate_splits(
    predict: Predict,
    data: Dataset,
    partition: Partition,
    progress: Callable[[float], None] = lambda fraction: None,
) -> dict[str, dict[str, Any]]:
    """Errors of a prediction on ``test``, ``held_out_queries``, ``held_out_directions`` and ``training``
    queries; a set without queries is left out. The exposure of all is that of the first. `progress` is called
    with the fraction of the queries that is done.

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
    found, done, total = dict[str, dict[str, Any]](), 0, sum(map(len, parts.values()))
    for name, queries in parts.items():
        progress(done / total)
        found[name] = split_errors(predict, queries, data, exposure)
        done += len(queries)
    return found


def check_aspect(material: Material, data: Dataset) -> None:
    """Refuse a data set whose tile has another aspect than a material's."""
    own, other = material.lattice.aspect, data.lattice.aspect
    if own != other:
        what = f"its tile has the aspect {other:g}, the material's {own:g}"
        raise InputError(what, where=data.folder)


def foreign_inputs(material: Material, data: Dataset) -> list[str]:
    """Roles of input files (height, base_color, …) that differ from those of the material's training data,
    where both record them."""
    trained = material.description["data"].get("inputs") or {}
    given = data.manifest.get("inputs") or {}
    both = sorted({*trained, *given}) if trained and given else []
    return [role for role in both if trained.get(role) != given.get(role)]


def evaluate(material: Material | str | Path, shards: str | Path | DataFolder) -> dict[str, dict[str, Any]]:
    """Evaluate a fitted material on a data set of any layout.

    Held-out queries are selected by the material's own configuration; they are held out only in the data set
    that the material was fitted to.

    Parameters
    ----------
    material : Material, str or Path
        The fitted material, or its folder.
    shards : str or Path
        Folder made by ``mbtf-gen``, or its URL.

    Returns
    -------
    dict
        ``errors``: those of values by split, ``test``, ``held_out_queries``, ``held_out_directions`` and
        ``training``; ``transmittance``: its errors by split, where both material and data have one. The same
        plain data as in ``material.json``, see :func:`split_errors`: estimates with ``value``, ``error`` (one
        standard error) and ``n``, among them the ``unexplained`` variance (1 - R²). Values that the noise
        hides are None. ``Estimate.from_dict`` (:mod:`mbtf_core.stats`) makes an object of each.

    Raises
    ------
    InputError
        Shards are missing, corrupt, or of another aspect ratio.
    """
    from mbtf_fit.material.material import Material

    if not isinstance(material, Material):
        material = Material.load(material)
    data = Dataset.open(shards)
    check_aspect(material, data)
    partition = load_training(data, material.config.held_out, material.config.seed, memory=None)
    found = {"errors": evaluate_splits(material.predict, data, partition)}
    if material.transmittance is not None and has_transmittance(data):
        found["transmittance"] = evaluate_transmittance(material.transmittance, data, partition.selection)
    return found


def score_predictions(file: str | Path, shards: str | Path | DataFolder) -> dict[str, dict[str, Any]]:
    """Errors of predictions that any code made for the test queries of a data set.

    Parameters
    ----------
    file : str or Path
        npz file with the array ``value``: predicted values in 1/sr of all test queries, the shards' arrays
        one after the other, (n, 3) or with the axes of images.
    shards : str or Path
        Folder made by ``mbtf-gen``.

    Returns
    -------
    dict
        As of :func:`evaluate`, with the errors of ``test`` alone.

    Raises
    ------
    InputError
        The file cannot be read, or its values are not as many as the test queries, or not finite; the data
        set has no test queries.
    """
    data = Dataset.open(shards)
    queries = load_split(data, "test")
    value = _read_values(Path(file))
    if value.ndim < 2 or value.shape[-1] != 3 or value.size != 3 * len(queries):
        raise InputError(
            f"'value' has the shape {value.shape}; the data set has {len(queries)} test queries of 3 numbers",
            where=file,
            hint="predict the queries of all test shards, in their order",
        )
    bad = np.flatnonzero(~np.isfinite(value.reshape(-1, 3)).all(axis=1))
    if len(bad):
        raise InputError(
            f"'value' is NaN or infinite at {len(bad)} queries, first at query {bad[0]}", where=file
        )
    return {"errors": {"test": split_errors(lambda _: value.reshape(-1, 3), queries, data)}}


# What NumPy raises of files that are damaged, encrypted or something else.
_NO_NPZ = (
    *(AttributeError, EOFError, KeyError, MemoryError, RuntimeError, TypeError, ValueError),
    *(BadZipFile, zlib.error),
)


def _read_values(file: Path) -> F32:
    try:
        with opened(file) as stream, np.load(stream) as arrays:
            value = arrays["value"]
            # What float32 cannot hold is infinite, which is refused.
            with np.errstate(over="ignore"):
                return value.astype(np.float32, casting="same_kind")
    except _NO_NPZ as error:
        raise InputError("is no npz file with the array 'value'", where=file) from error
