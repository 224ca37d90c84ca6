"""How different two pictures look: FLIP, SSIM and, where it was asked for, ST-LPIPS, at stated exposures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from mbtf_pipeline.compare.flip import Flip, flip
from mbtf_pipeline.compare.ssim import ssim
from mbtf_pipeline.compare.st_lpips import st_lpips


@dataclass(frozen=True)
class Visible:
    """Visible differences of two pictures.

    Attributes
    ----------
    ssim : None where the pictures are too small for it
    st_lpips : None where they are too small, or it was not asked for
    """

    flip: Flip
    ssim: float | None
    st_lpips: float | None

    def as_dict(self) -> dict[str, Any]:
        """Plain data, without the map of FLIP."""
        return {"flip": self.flip.as_dict(), "ssim": self.ssim, "st_lpips": self.st_lpips}


def visible_difference(
    picture: ArrayLike, reference: ArrayLike, white: float, *, learned: bool = False
) -> Visible:
    """All measures of linear pictures (rows, columns, 3) in 1/sr.

    Parameters
    ----------
    white : linear value shown as white at 0 EV, 1/sr
    learned : whether ST-LPIPS is measured, too

    Raises
    ------
    EngineError : ST-LPIPS was asked for and its weights are not installed
    """
    return Visible(
        flip(picture, reference, white),
        ssim(picture, reference, white),
        st_lpips(picture, reference, white) if learned else None,
    )


@dataclass(frozen=True)
class Measure:
    """A visible measure as tables show it.

    Attributes
    ----------
    key : ``flip.ldr`` and so on, in the comparison's record; title : in tables
    best : what equal pictures have; the distance from it is the difference
    """

    key: str
    title: str
    best: float = 0.0

    def of(self, record: Mapping[str, Any]) -> float | None:
        """The number in a picture's record; None where it was not measured."""
        found: Any = record
        for part in self.key.split("."):
            found = found.get(part)
            if found is None:
                return None
        return float(found)

    def is_noise(self, value: float, noise: float | None) -> bool:
        """Whether a number is no farther from the best than what noise alone gives."""
        return noise is not None and abs(value - self.best) <= abs(noise - self.best)


MEASURES = (
    Measure("flip.ldr", "LDR-FLIP"),
    Measure("flip.hdr", "HDR-FLIP"),
    Measure("ssim", "SSIM", 1.0),
    Measure("st_lpips", "ST-LPIPS"),
)


def measured(pictures: list[Mapping[str, Any]], fits: list[str]) -> list[Measure]:
    """Those that some picture of a comparison has."""
    made = [p["fits"][fit] for p in pictures for fit in fits]
    return [m for m in MEASURES if any(m.of(record) is not None for record in made)]


def visible_text(measure: Measure, record: Mapping[str, Any], reference: Mapping[str, Any]) -> str:
    """A fit's number; where it is no more than what noise alone gives, that is said."""
    value, noise = measure.of(record), measure.of(reference)
    if value is None:
        return "–"
    more = f", not above noise alone ({noise:.3f})" if measure.is_noise(value, noise) else ""
    return f"{value:.3f}{more}"
