"""Perceptual metrics of two images: FLIP, SSIM and, on request, ST-LPIPS, at stated exposures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from mbtf_pipeline.compare.flip import F32, flip
from mbtf_pipeline.compare.ssim import ssim
from mbtf_pipeline.compare.st_lpips import st_lpips


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
