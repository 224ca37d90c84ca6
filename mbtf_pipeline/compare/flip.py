"""FLIP and HDR-FLIP of a picture against its reference, at stated exposures.

FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; HDR-FLIP: Andersson
et al., "Visualizing Errors in Rendered High Dynamic Range Images", Eurographics 2021. Both answer how visible
a difference is when the two pictures take turns on a screen: 0 none, 1 the largest. Noise of the reference is
a difference as well, so the reference's two halves are compared in the same way beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

F32 = NDArray[np.float32]

# Exposures of HDR-FLIP in stops about the one at which the white point is shown as white.
EXPOSURES = (-2.0, 0.0, 2.0)
TONE_MAPPER = "ACES"
# Pixels per degree of the viewer's sight: a 0.7 m wide screen of 3840 pixels seen from 0.7 m.
PIXELS_PER_DEGREE = 67.0

DEFINITION = (
    "LDR-FLIP (Andersson et al. 2020): mean over pixels of how visible the difference is at exposure 0 EV, "
    "values above white cut off; HDR-FLIP (2021): per pixel the largest of the differences at "
    + ", ".join(f"{stop:+g}".replace("-", "−").replace("+0", "0") for stop in EXPOSURES)
    + f" EV, tone mapper {TONE_MAPPER}; both for {PIXELS_PER_DEGREE:g} pixels per degree; 0 is none, 1 the "
    "largest. The reference's noise counts as difference: half against half shows what noise alone gives"
)


@dataclass(frozen=True)
class Flip:
    """Visible difference of two pictures.

    Attributes
    ----------
    ldr, hdr : means over pixels, from 0 to 1
    hdr_map : (rows, columns), the HDR-FLIP of each pixel
    """

    ldr: float
    hdr: float
    hdr_map: F32

    def as_dict(self) -> dict[str, float]:
        """Plain data, without the map."""
        return {"ldr": self.ldr, "hdr": self.hdr}


def flip(picture: ArrayLike, reference: ArrayLike, white: float) -> Flip:
    """FLIP of linear pictures (rows, columns, 3) in 1/sr.

    Parameters
    ----------
    white : linear value shown as white at 0 EV, 1/sr
    """
    test, truth = (np.maximum(np.asarray(x, np.float32) / np.float32(white), 0) for x in (picture, reference))
    hdr_map, hdr = _evaluate(
        truth,
        test,
        "HDR",
        startExposure=EXPOSURES[0],
        stopExposure=EXPOSURES[-1],
        numExposures=len(EXPOSURES),
        tonemapper=TONE_MAPPER,
    )
    _, ldr = _evaluate(np.minimum(truth, 1), np.minimum(test, 1), "LDR")
    return Flip(ldr, hdr, hdr_map)


def _evaluate(reference: F32, test: F32, kind: str, **parameters: Any) -> tuple[F32, float]:
    """(map, mean over pixels) of linear pictures."""
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
