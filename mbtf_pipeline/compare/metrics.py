"""Figures of merit of a picture against a reference whose two halves are independent.

All are free of the reference's noise in expectation: p is the picture, a and b are the halves, ``(p-a)(p-b)``
has the expectation ``(p-t)²`` with t the truth. Error bars are one standard error from the scatter over
pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbtf_core.stats import Estimate, mean_estimate, noise_free_mse
from mbtf_pipeline.compare.flip import DEFINITION as FLIP_DEFINITION
from mbtf_pipeline.compare.ssim import DEFINITION as SSIM_DEFINITION
from mbtf_pipeline.compare.st_lpips import DEFINITION as ST_LPIPS_DEFINITION

# Floor of the relative error's denominator, as a share of the picture's mean value.
RELATIVE_FLOOR = 0.1

DEFINITIONS: dict[str, str] = {
    "mse": "mean of (p-a)(p-b) over pixels and channels, 1/sr²; p the picture, a and b the reference's "
    "independent halves: the reference's noise drops out, so a value may come out slightly negative",
    "psnr": "10 log10(peak²/MSE) in dB, with the noise-free MSE; its peak is the value shown as white "
    "at 0 EV",
    "relative_mse": "mean of (p-a)(p-b) / (t² + (0.1 m)²), t = (a+b)/2 per pixel and channel, m the "
    "picture's mean value",
    "flip": FLIP_DEFINITION,
    "ssim": SSIM_DEFINITION,
    "st_lpips": ST_LPIPS_DEFINITION,
    "error_bar": "one standard error, from the scatter over the picture's pixels or the data's queries; a "
    "value within two of its own is printed as below two error bars, with the bar",
}


@dataclass(frozen=True)
class Score:
    """Errors of one picture.

    Attributes
    ----------
    mse : noise-free mean squared error, 1/sr²
    relative_mse : a pure number
    """

    mse: Estimate
    relative_mse: Estimate

    def psnr(self, peak: float) -> tuple[float, float]:
        """(value, standard error) in dB; infinite where the error lies below the reference's noise.

        Parameters
        ----------
        peak : the value taken as full scale, 1/sr
        """
        if self.mse.value <= 0 or peak <= 0:
            return math.inf, math.inf
        value = 10.0 * math.log10(peak**2 / self.mse.value)
        return value, 10.0 / math.log(10.0) * self.mse.relative_error

    def as_dict(self, peak: float) -> dict[str, Any]:
        """Plain data; numbers that are not finite become None."""
        value, error = self.psnr(peak)
        psnr = Estimate(value, error, self.mse.n)
        return {
            "mse": self.mse.as_dict(),
            "psnr": psnr.as_dict(),
            "relative_mse": self.relative_mse.as_dict(),
        }


def score(picture: ArrayLike, value_a: ArrayLike, value_b: ArrayLike) -> Score:
    """Errors of a picture (rows, columns, 3) against both halves of its reference, same shape."""
    p, a, b = (np.asarray(x, np.float64).reshape(-1, 3) for x in (picture, value_a, value_b))
    t = 0.5 * (a + b)
    floor = RELATIVE_FLOOR * float(t.mean())
    if floor > 0:
        relative = mean_estimate((p - a) * (p - b) / (t**2 + floor**2))
    else:  # a black reference has no scale that an error could be relative to
        relative = Estimate(math.nan, math.inf, len(p))
    return Score(noise_free_mse(p, a, b), relative)


def halves_score(first: tuple[ArrayLike, ArrayLike], value_a: ArrayLike, value_b: ArrayLike) -> Estimate:
    """Noise-free mean squared difference of two references, each given as independent halves."""
    a1, b1, a2, b2 = (np.asarray(x, np.float64).reshape(-1, 3) for x in (*first, value_a, value_b))
    return mean_estimate((a1 - a2) * (b1 - b2))


def white_point(values: list[ArrayLike]) -> float:
    """The linear value shown as white: the median over pictures of the 95th percentile, over 0.8.

    1 where every picture is black.
    """
    bright = [float(np.percentile(np.asarray(v, np.float64).mean(axis=-1), 95)) for v in values]
    level = float(np.median(bright)) / 0.8
    return level if level > 0 else 1.0
