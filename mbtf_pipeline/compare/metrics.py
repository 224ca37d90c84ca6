"""Errors of images against path-traced references, and of fits on a data set.

References and data are stored as two independent halves. The estimates are paired (split-half): with the
image p and the halves a and b of the reference, ``(p-a)(p-b)`` has the expectation ``(p-t)²``, where t is the
true image. The noise of the reference therefore does not bias the error. Error bars are one standard error
over pixels or queries.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from mbtf_core.stats import (
    Estimate,
    by_group,
    level_groups,
    mean_estimate,
    mse_difference,
    noise_free_mse,
    psnr,
)
from mbtf_pipeline.compare.perceptual_metrics import PERCEPTUAL_DEFINITIONS

if TYPE_CHECKING:
    from mbtf_core.data.dataset import Dataset
    from mbtf_fit import Material

# Floor of the relative error's denominator, as a fraction of the image's mean value.
RELATIVE_FLOOR = 0.1

DEFINITIONS: dict[str, str] = {
    "mse": "mean of (p-a)(p-b) over pixels and channels, in 1/sr². p is the image; a and b are independent "
    "halves of the reference. The reference noise does not bias it, so it can be slightly negative.",
    "psnr": "10 log10(peak²/MSE) in dB, with the noise-free MSE. The peak is the value shown as white.",
    "relative_mse": "mean of (p-a)(p-b) / (t² + (0.1 m)²). t = (a+b)/2 per pixel and channel; m is the mean "
    "value of the image.",
    **PERCEPTUAL_DEFINITIONS,
    "error_bar": "one standard error, over pixels of an image or queries of a data set. A value within "
    "two standard errors of zero is marked as not significant.",
}


def image_errors(
    image: ArrayLike, value_a: ArrayLike, value_b: ArrayLike, peak: float
) -> dict[str, Estimate]:
    """Errors of an image (rows, columns, 3) against both halves of its reference, same shape.

    Returns
    -------
    dict
        ``mse`` in 1/sr², ``psnr`` in dB for full scale at `peak` in 1/sr, ``relative_mse``.
    """
    p, a, b = (np.asarray(x, np.float64).reshape(-1, 3) for x in (image, value_a, value_b))
    t = 0.5 * (a + b)
    floor = RELATIVE_FLOOR * float(t.mean())
    if floor > 0:
        relative = mean_estimate((p - a) * (p - b) / (t**2 + floor**2))
    else:  # a black reference has no scale
        relative = Estimate(math.nan, math.inf, len(p))
    mse = noise_free_mse(p, a, b)
    return {"mse": mse, "psnr": psnr(mse, peak), "relative_mse": relative}


def dataset_errors(materials: Mapping[str, Material], data: Dataset) -> dict[str, Any]:
    """Errors of every fit on the test split of one data set, and on the splits held out in its own training.

    All fits but the first also have ``mse_minus_first``: their MSE minus that of the first fit on the same
    test queries, overall and by level. Of measured data, which have one value per query, errors include the
    noise and say so (``includes_noise``); differences do not. Returns plain data by name of the fit.

    Raises
    ------
    InputError : a test shard is missing or corrupt
    """
    from mbtf_fit.data.loader import load_split
    from mbtf_fit.evaluation import split_errors

    test = load_split(data, "test")
    labels = level_groups(test.sigma, data.lattice.finest)
    first: Any = None
    out: dict[str, Any] = {}
    for name, material in materials.items():
        value = material.predict(test)
        found = split_errors(lambda queries: value, test, data)  # noqa: B023
        own = material.description["training"]["errors"]
        splits = {split: errors for split, errors in own.items() if split != "test"}
        weights, training = material.description["weights"], material.description["training"]
        record = {
            "splits": {"test": found, **splits},
            "network_weights": weights["network_weights"],
            "texels": weights["texels"],
            "training_seconds": training["seconds"],
            "training_steps": training["steps"],
        }
        if first is None:
            first = value
        else:
            levels = by_group(mse_difference, labels, value, first, *test.halves)
            record["mse_minus_first"] = {
                **mse_difference(value, first, *test.halves).as_dict(),
                "levels": {str(level): e.as_dict() for level, e in levels.items()},
            }
        out[name] = record
    return out
