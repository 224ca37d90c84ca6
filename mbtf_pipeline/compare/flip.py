"""FLIP and HDR-FLIP of an image against its reference, at the exposure of the comparison.

FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; HDR-FLIP: Andersson
et al., "Visualizing Errors in Rendered High Dynamic Range Images", Eurographics 2021. Both predict how
visible a difference is when two images alternate on a screen, from 0 (none) to 1 (maximal). They respond to
noise of the reference too, so the two halves of the reference are compared with each other as a noise
baseline.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

F32 = NDArray[np.float32]

# Exposures of HDR-FLIP in stops from that of the comparison.
EXPOSURES = (-2.0, 0.0, 2.0)
TONE_MAPPER = "ACES"
# Pixels per degree of visual angle: a 0.7 m wide screen of 3840 pixels at a distance of 0.7 m.
PIXELS_PER_DEGREE = 67.0

_STOPS = ", ".join(f"{stop:+g}".replace("-", "−").replace("+0", "0") for stop in EXPOSURES)
DEFINITION = (
    "LDR-FLIP (Andersson et al. 2020) is the mean over pixels of the visible difference, with values above "
    f"white clipped. HDR-FLIP (2021) takes per pixel the largest difference at {_STOPS} stops from the "
    f"comparison's exposure, tone mapper {TONE_MAPPER}. Both assume {PIXELS_PER_DEGREE:g} pixels per degree; "
    "0 is no difference, 1 the largest. They include the reference noise; its two estimates, compared, "
    "give a baseline."
)


class Flip(NamedTuple):
    """FLIP of two images: means over pixels from 0 to 1, and HDR-FLIP per pixel (rows, columns)."""

    ldr: float
    hdr: float
    hdr_map: F32


def flip(image: ArrayLike, reference: ArrayLike, white: float) -> Flip:
    """FLIP of linear images (rows, columns, 3) in 1/sr.

    Parameters
    ----------
    white : linear value displayed as white, 1/sr
    """
    test, truth = (np.maximum(np.asarray(x, np.float32) / np.float32(white), 0) for x in (image, reference))
    exposures = {
        "startExposure": EXPOSURES[0],
        "stopExposure": EXPOSURES[-1],
        "numExposures": len(EXPOSURES),
    }
    hdr_map, hdr = _evaluate(truth, test, "HDR", **exposures, tonemapper=TONE_MAPPER)
    _, ldr = _evaluate(np.minimum(truth, 1), np.minimum(test, 1), "LDR")
    return Flip(ldr, hdr, hdr_map)


def _evaluate(reference: F32, test: F32, kind: str, **parameters: Any) -> tuple[F32, float]:
    """(map, mean over pixels) of linear images."""
    import flip_evaluator

    field, mean, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference),
        np.ascontiguousarray(test),
        kind,
        inputsRGB=False,
        applyMagma=False,
        parameters={"ppd": PIXELS_PER_DEGREE, **parameters},
    )
    return np.asarray(field, np.float32)[..., 0], float(mean)
