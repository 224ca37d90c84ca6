"""SSIM of an image against its reference, as displayed in sRGB.

Wang, Bovik, Sheikh, Simoncelli: "Image Quality Assessment: From Error Visibility to Structural Similarity",
IEEE TIP 13(4), 2004, as implemented in scikit-image with the paper's Gaussian window. SSIM responds to
noise of the reference too, so the two halves of the reference are compared with each other as a noise
baseline.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.color import linear_to_srgb

# Standard deviation of the window in pixels, and its size; both as in the paper (11 × 11 pixels).
WINDOW = 1.5
_WINDOW_SIZE = 11

DEFINITION = (
    "structural similarity (Wang et al. 2004) of the images in sRGB, values above white clipped: "
    f"mean over pixels and channels, Gaussian window with σ = {WINDOW:g} pixels; 1 means equal. It includes "
    "the reference noise; its two estimates, compared, give a baseline."
)


def to_srgb(image: ArrayLike, white: float) -> NDArray[np.float64]:
    """sRGB in [0, 1] of linear values (..., 3) in 1/sr, clipped at `white`."""
    linear = np.clip(np.asarray(image, np.float64) / white, 0.0, 1.0)
    return np.asarray(linear_to_srgb(linear), np.float64)


def ssim(image: ArrayLike, reference: ArrayLike, white: float) -> float | None:
    """SSIM of linear images (rows, columns, 3) in 1/sr; None if a side is shorter than the window.

    Parameters
    ----------
    white : linear value displayed as white, 1/sr
    """
    from skimage.metrics import structural_similarity

    test, truth = to_srgb(image, white), to_srgb(reference, white)
    if min(truth.shape[:2]) < _WINDOW_SIZE:
        return None
    return float(
        structural_similarity(
            truth,
            test,
            data_range=1.0,
            channel_axis=-1,
            gaussian_weights=True,
            sigma=WINDOW,
            use_sample_covariance=False,
        )
    )
