"""Errors of an image against a path-traced reference that is stored as two independent halves.

The estimates are paired (split-half): with the image p and the halves a and b of the reference,
``(p-a)(p-b)`` has the expectation ``(p-t)²``, where t is the true image. The noise of the reference
therefore does not bias the error. Error bars are one standard error over pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from mbtf_core.stats import Estimate, mean_estimate, noise_free_mse, psnr
from mbtf_pipeline.compare.perceptual_metrics import FLIP_DEFINITION, SSIM_DEFINITION
from mbtf_pipeline.compare.st_lpips import DEFINITION as ST_LPIPS_DEFINITION

# Floor of the relative error's denominator, as a fraction of the image's mean value.
RELATIVE_FLOOR = 0.1

DEFINITIONS: dict[str, str] = {
    "mse": "mean of (p-a)(p-b) over pixels and channels, in 1/sr². p is the image; a and b are independent "
    "halves of the reference. The reference noise does not bias it, so it can be slightly negative.",
    "psnr": "10 log10(peak²/MSE) in dB, with the noise-free MSE. The peak is the value shown as white.",
    "relative_mse": "mean of (p-a)(p-b) / (t² + (0.1 m)²). t = (a+b)/2 per pixel and channel; m is the mean "
    "value of the image.",
    "flip": FLIP_DEFINITION,
    "ssim": SSIM_DEFINITION,
    "st_lpips": ST_LPIPS_DEFINITION,
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


def reference_difference(
    first: tuple[ArrayLike, ArrayLike], value_a: ArrayLike, value_b: ArrayLike
) -> Estimate:
    """Noise-free mean squared difference of two references, each given as two independent halves."""
    a1, b1, a2, b2 = (np.asarray(x, np.float64).reshape(-1, 3) for x in (*first, value_a, value_b))
    return mean_estimate((a1 - a2) * (b1 - b2))
