"""SSIM of a picture against its reference, as it is seen on a screen at 0 EV.

Wang, Bovik, Sheikh, Simoncelli: "Image Quality Assessment: From Error Visibility to Structural Similarity",
IEEE TIP 13(4), 2004, in scikit-image's implementation with the paper's Gaussian window. Noise of the
reference is a difference as well, so the reference's two halves are compared in the same way beside it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.color import linear_to_srgb

# Standard deviation of the window in pixels, and where it ends; both the paper's (11 × 11 pixels).
WINDOW = 1.5
_WINDOW_SIZE = 11

DEFINITION = (
    "structural similarity (Wang et al. 2004) of the pictures in sRGB at 0 EV, values above white cut off: "
    f"mean over pixels and channels, Gaussian window of {WINDOW:g} pixels; 1 is equal. The reference's noise "
    "counts as difference: half against half shows what noise alone gives"
)


def on_screen(picture: ArrayLike, white: float) -> NDArray[np.float64]:
    """What a screen shows of linear values (..., 3) in 1/sr, from 0 to 1: sRGB, cut off at `white`."""
    linear = np.clip(np.asarray(picture, np.float64) / white, 0.0, 1.0)
    return np.asarray(linear_to_srgb(linear), np.float64)


def ssim(picture: ArrayLike, reference: ArrayLike, white: float) -> float | None:
    """SSIM of linear pictures (rows, columns, 3) in 1/sr; None where a side is shorter than the window.

    Parameters
    ----------
    white : linear value shown as white at 0 EV, 1/sr
    """
    from skimage.metrics import structural_similarity

    test, truth = on_screen(picture, white), on_screen(reference, white)
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
