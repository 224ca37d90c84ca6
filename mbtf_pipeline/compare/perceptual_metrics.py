"""Perceptual metrics of two images at stated exposures: FLIP, SSIM and, on request, ST-LPIPS.

FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; HDR-FLIP: Andersson
et al., "Visualizing Errors in Rendered High Dynamic Range Images", Eurographics 2021. Both predict how
visible a difference is when two images alternate on a screen, from 0 (none) to 1 (maximal). SSIM: Wang,
Bovik, Sheikh, Simoncelli, "Image Quality Assessment: From Error Visibility to Structural Similarity", IEEE
TIP 13(4), 2004, as implemented in scikit-image with the paper's Gaussian window. All respond to noise of the
reference too, so the two halves of the reference are compared with each other as a noise baseline.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_pipeline.compare.st_lpips import st_lpips, to_srgb

F32 = NDArray[np.float32]

# Exposures of HDR-FLIP in stops from that of the comparison.
EXPOSURES = (-2.0, 0.0, 2.0)
TONE_MAPPER = "ACES"
# Pixels per degree of visual angle: a 0.7 m wide screen of 3840 pixels at a distance of 0.7 m.
PIXELS_PER_DEGREE = 67.0

_STOPS = ", ".join(f"{stop:+g}".replace("-", "−").replace("+0", "0") for stop in EXPOSURES)
FLIP_DEFINITION = (
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


# Standard deviation of the window in pixels, and its size; both as in the paper (11 × 11 pixels).
WINDOW = 1.5
_WINDOW_SIZE = 11

SSIM_DEFINITION = (
    "structural similarity (Wang et al. 2004) of the images in sRGB, values above white clipped: "
    f"mean over pixels and channels, Gaussian window with σ = {WINDOW:g} pixels; 1 means equal. It includes "
    "the reference noise; its two estimates, compared, give a baseline."
)


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


def perceptual_scores(
    image: ArrayLike, reference: ArrayLike, white: float, with_st_lpips: bool
) -> tuple[dict[str, Any], F32]:
    """Perceptual metrics of linear images (rows, columns, 3) in 1/sr, and the map of HDR-FLIP.

    SSIM and ST-LPIPS are None for images that are too small.

    Parameters
    ----------
    white : linear value displayed as white, 1/sr

    Raises
    ------
    EngineError : ST-LPIPS was requested and its weights are not installed
    """
    ldr, hdr, hdr_map = flip(image, reference, white)
    learned = st_lpips(image, reference, white) if with_st_lpips else None
    return {
        "flip": {"ldr": ldr, "hdr": hdr},
        "ssim": ssim(image, reference, white),
        "st_lpips": learned,
    }, hdr_map


@dataclass(frozen=True)
class PerceptualMetric:
    """A perceptual metric as tables show it.

    Attributes
    ----------
    key : ``flip.ldr`` and so on, in the comparison's record
    title : in tables
    best : value for equal images
    """

    key: str
    title: str
    best: float = 0.0

    def of(self, record: Mapping[str, Any]) -> float | None:
        """Its value in an image's record; None if it was not computed."""
        found: Any = record
        for part in self.key.split("."):
            found = found.get(part)
            if found is None:
                return None
        return float(found)

    def text(self, value: float | None, noise: float | None, *, with_noise: bool = True) -> str:
        """The value, marked where the noise of the reference alone explains it."""
        if value is None:
            return "–"
        if noise is None or abs(value - self.best) > abs(noise - self.best):
            return f"{value:.3f}"
        return f"{value:.3f}, within noise" + (f" ({noise:.3f})" if with_noise else "")


PERCEPTUAL_METRICS = (
    PerceptualMetric("flip.ldr", "LDR-FLIP"),
    PerceptualMetric("flip.hdr", "HDR-FLIP"),
    PerceptualMetric("ssim", "SSIM", 1.0),
    PerceptualMetric("st_lpips", "ST-LPIPS"),
)


def available_metrics(pictures: list[Mapping[str, Any]], fits: list[str]) -> list[PerceptualMetric]:
    """Metrics that at least one image of a comparison has."""
    records = [p["fits"][fit] for p in pictures for fit in fits]
    return [m for m in PERCEPTUAL_METRICS if any(m.of(record) is not None for record in records)]
