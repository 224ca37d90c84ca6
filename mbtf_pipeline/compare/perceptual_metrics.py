"""Perceptual metrics of two images: FLIP at stated exposures, SSIM and, on request, ST-LPIPS.

FLIP: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; HDR-FLIP: Andersson
et al., "Visualizing Errors in Rendered High Dynamic Range Images", Eurographics 2021. Both predict how
visible a difference is when two images alternate on a screen, from 0 (none) to 1 (maximal). SSIM: Wang,
Bovik, Sheikh, Simoncelli, "Image Quality Assessment: From Error Visibility to Structural Similarity", IEEE
TIP 13(4), 2004, as implemented in scikit-image with the paper's Gaussian window. ST-LPIPS: Ghildyal and Liu,
"Shift-tolerant Perceptual Similarity Metric", ECCV 2022, with the weights of the package ``stlpips-pytorch``
(network ``alex``), an optional extra. Its code is not used: its dependencies would install another PyTorch.
All respond to noise of the reference too, so the two halves of the reference are compared with each other as
a noise baseline.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.color import linear_to_srgb
from mbtf_core.extras import extra_error

if TYPE_CHECKING:
    from torch import Tensor

F32 = NDArray[np.float32]

# Exposures of HDR-FLIP in stops from that of the comparison.
EXPOSURES = (-2.0, 0.0, 2.0)
TONE_MAPPER = "ACES"
# Pixels per degree of visual angle: a 0.7 m wide screen of 3840 pixels at a distance of 0.7 m.
PIXELS_PER_DEGREE = 67.0

# Standard deviation of SSIM's window in pixels, and its size; both as in the paper (11 × 11 pixels).
WINDOW = 1.5
_WINDOW_SIZE = 11
# Its constants, of values from 0 to 1.
_C1, _C2 = 0.01**2, 0.03**2

# Package of ST-LPIPS, its weights, and the smallest image side for which its deepest layer is not empty.
PACKAGE = "stlpips_pytorch"
_WEIGHTS = Path("weights/vST0.0/alex_shift_tolerant.pth")
_SMALLEST = 32

_STOPS = ", ".join(f"{stop:+g}".replace("-", "−").replace("+0", "0") for stop in EXPOSURES)
_BASELINE = "include the reference noise; its two estimates, compared, give a baseline."
PERCEPTUAL_DEFINITIONS = {
    "flip": "LDR-FLIP (Andersson et al. 2020) is the mean over pixels of the visible difference, with values "
    f"above white clipped. HDR-FLIP (2021) takes per pixel the largest difference at {_STOPS} stops from the "
    f"comparison's exposure, tone mapper {TONE_MAPPER}. Both assume {PIXELS_PER_DEGREE:g} pixels per degree; "
    f"0 is no difference, 1 the largest. They {_BASELINE}",
    "ssim": "structural similarity (Wang et al. 2004) of the images in sRGB, values above white clipped: "
    f"mean over pixels and channels, Gaussian window with σ = {WINDOW:g} pixels; 1 means equal. Its values "
    f"{_BASELINE}",
    "st_lpips": "ST-LPIPS (Ghildyal and Liu 2022, network alex) of the images in sRGB, with values above "
    f"white clipped; 0 means equal. Its values {_BASELINE}",
}


def flip(image: ArrayLike, reference: ArrayLike, white: float) -> tuple[float, float, F32]:
    """LDR-FLIP and HDR-FLIP of linear images (rows, columns, 3) in 1/sr, from 0 to 1: means over pixels, and
    HDR-FLIP per pixel (rows, columns). `white` is the linear value displayed as white, in 1/sr."""
    test, truth = (np.maximum(np.asarray(x, np.float32) / np.float32(white), 0) for x in (image, reference))
    stops = {"startExposure": EXPOSURES[0], "stopExposure": EXPOSURES[-1], "numExposures": len(EXPOSURES)}
    hdr_map, hdr = _evaluate(truth, test, "HDR", **stops, tonemapper=TONE_MAPPER)
    _, ldr = _evaluate(np.minimum(truth, 1), np.minimum(test, 1), "LDR")
    return ldr, hdr, hdr_map


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


def ssim(image: ArrayLike, reference: ArrayLike, white: float) -> float | None:
    """SSIM of linear images (rows, columns, 3) in 1/sr, of which `white` is displayed as white; None if a
    side is shorter than the window."""
    from scipy.ndimage import gaussian_filter

    test, truth = to_srgb(image, white), to_srgb(reference, white)
    if min(truth.shape[:2]) < _WINDOW_SIZE:
        return None
    radius = _WINDOW_SIZE // 2

    def local_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
        found = gaussian_filter(values, WINDOW, radius=radius, axes=(0, 1))
        return np.asarray(found[radius:-radius, radius:-radius])

    x, y = local_mean(truth), local_mean(test)
    variances = local_mean(truth * truth) - x * x + local_mean(test * test) - y * y
    covariance = local_mean(truth * test) - x * y
    luminance = (2 * x * y + _C1) / (x * x + y * y + _C1)
    return float(np.mean(luminance * (2 * covariance + _C2) / (variances + _C2)))


def to_srgb(image: ArrayLike, white: float) -> NDArray[np.float64]:
    """sRGB in [0, 1] of linear values (..., 3) in 1/sr, clipped at `white`."""
    linear = np.clip(np.asarray(image, np.float64) / white, 0.0, 1.0)
    return np.asarray(linear_to_srgb(linear), np.float64)


def weights_file() -> Path | None:
    """Path of the package's weights; None if it is not installed."""
    spec = find_spec(PACKAGE)
    places = (spec and spec.submodule_search_locations) or []
    return next((path for place in places if (path := Path(place) / _WEIGHTS).is_file()), None)


def require() -> Path:
    """Path of the weights; an EngineError where the package with its weights is not installed."""
    file = weights_file()
    if file is None:
        raise extra_error(PACKAGE, "compare.perceptual_metrics")
    return file


@lru_cache(maxsize=1)
def _tensors() -> dict[str, Tensor]:
    """Tensors of the network, named as in the package's file."""
    import torch

    return dict(torch.load(require(), map_location="cpu", weights_only=True))


def _features(x: Tensor) -> list[Tensor]:
    """Features of AlexNet's five layers for an image (1, 3, rows, columns) in [-1, 1], normalized over
    channels. A 1 2 1 blur with reflected edges, two pixels wide, replaces the strides."""
    import torch
    from torch.nn.functional import conv2d, max_pool2d, pad

    tensors = _tensors()

    def layer(x: Tensor, name: str, padding: int) -> Tensor:
        return conv2d(x, tensors[f"net.{name}.weight"], tensors[f"net.{name}.bias"], padding=padding)

    def blurred(x: Tensor) -> Tensor:
        row = torch.tensor([0.25, 0.5, 0.25])
        kernel = (row[:, None] * row).expand(x.shape[1], 1, 3, 3)
        return conv2d(pad(x, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=x.shape[1])

    x = (x - tensors["scaling_layer.shift"]) / tensors["scaling_layer.scale"]
    first = blurred(layer(x, "slice1.0", 2)).relu()
    second = layer(blurred(max_pool2d(first, 3, stride=1)), "slice2.5", 2).relu()
    third = layer(blurred(max_pool2d(second, 3, stride=1)), "slice3.9", 1).relu()
    fourth = layer(third, "slice4.11", 1).relu()
    found = [first, second, third, fourth, layer(fourth, "slice5.13", 1).relu()]
    return [f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10) for f in found]


def st_lpips(image: ArrayLike, reference: ArrayLike, white: float) -> float | None:
    """ST-LPIPS of linear images (rows, columns, 3) in 1/sr, of which `white` is displayed as white; None for
    images too small for the network. Errors are those of :func:`require`."""
    import torch

    tensors = _tensors()
    if min(np.shape(reference)[:2]) < _SMALLEST:
        return None
    with torch.no_grad():
        first, second = (
            _features(
                torch.from_numpy((2.0 * to_srgb(x, white) - 1.0).astype(np.float32).transpose(2, 0, 1)[None])
            )
            for x in (image, reference)
        )
        weights = [tensors[f"lin{number}.model.1.weight"].view(1, -1, 1, 1) for number in range(len(first))]
        # Squared differences, weighted per channel and averaged over positions.
        return sum(
            float(((x - y).square() * w).sum(1).mean())
            for x, y, w in zip(first, second, weights, strict=True)
        )


def perceptual_scores(
    image: ArrayLike, reference: ArrayLike, white: float, with_st_lpips: bool
) -> tuple[dict[str, Any], F32]:
    """Perceptual metrics of linear images (rows, columns, 3) in 1/sr, of which `white` is displayed as white,
    and the map of HDR-FLIP. SSIM and ST-LPIPS are None for images that are too small; errors of the latter
    are those of :func:`require`."""
    ldr, hdr, hdr_map = flip(image, reference, white)
    learned = st_lpips(image, reference, white) if with_st_lpips else None
    return {
        "flip": {"ldr": ldr, "hdr": hdr},
        "ssim": ssim(image, reference, white),
        "st_lpips": learned,
    }, hdr_map


@dataclass(frozen=True)
class PerceptualMetric:
    """A perceptual metric as tables show it: its key in the comparison's record, such as ``flip.ldr``, and
    its value for equal images."""

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
