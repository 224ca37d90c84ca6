"""Consistency checks of a material's maps, as messages: heights, tiling, normals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import InputError
from mbtf_core.images.read import Image
from mbtf_gen.tile.maps.file_names import Convention
from mbtf_gen.tile.maps.normal_map import NormalFit
from mbtf_gen.tile.maps.tiling import Seam, broken

CONVENTION_NAMES: dict[Convention, str] = {"gl": "OpenGL", "dx": "DirectX"}
# Mean spread of the channels, relative to the largest number, beyond which an image is a color picture.
_COLORED = 0.02
# What a colored mask may be.
_MASK_MAP = "; if it is Unity's mask map, of metallic (R) and smoothness (A), name the file MaskMap"
# Levels, and codes between them, that 8-bit heights in a 16-bit file have.
_FEW_LEVELS, _FAR_APART = 1024, 16.0
# Ratio of a height scale to the one that the normal map suggests, above which a warning is given.
_FAR_OFF = 1.5


def refuse_color(image: Image, role: Literal["height", "opacity"]) -> None:
    """Refuse a color image as a gray map: channels that differ by more than 2% on average."""
    if image.stored.shape[2] < 3:
        return
    rgb = image.pixels[..., :3]
    largest = float(np.abs(rgb).max())
    if largest == 0 or float(np.mean(np.ptp(rgb, axis=-1))) <= _COLORED * largest:
        return
    red, green, blue = rgb.mean(axis=(0, 1))
    normals = abs(red - 0.5) < 0.1 and abs(green - 0.5) < 0.1 and blue > 0.7
    kind, channel, more = "a height map", "R", ""
    if role == "opacity":
        kind, channel, more = "an opacity map", "A" if image.pixels.shape[2] == 4 else "R", _MASK_MAP
    raise InputError(
        f"is colored{' like a normal map' if normals else ''}; {kind} is gray",
        where=image.path,
        hint="if one of its channels is meant, say so in a material.yaml: "
        f"{role}: {{file: {image.path.name}, channel: {channel}}}{more}",
    )


def coarse_step(codes: Codes, bits: int) -> float | None:
    """Quantization step of the heights in codes; None where it is too fine to show as terraces."""
    hidden = codes.levels <= _FEW_LEVELS and codes.spacing >= _FAR_APART
    return codes.rounding if bits == 8 or hidden else None


def level_warning(path: Path, codes: Codes, bits: int, step: float, smoothed: bool) -> str:
    """The warning that heights have few levels."""
    apart = f" {codes.spacing:.4g} codes apart" if codes.spacing > 1 else ""
    within = f"smoothed within {'half a code' if step == 1 else f'{step / 2:.3g} codes'}"
    done = within if smoothed else "not smoothed (dequantize: false)"
    return f"{path}: {bits}-bit heights with {codes.levels} distinct values{apart}; {done}"


def seam_warning(path: Path, seams: Sequence[Seam], factor: float) -> str | None:
    """The warning that heights do not tile; `factor` takes stored heights to tile widths."""
    bad = [s for s in seams if broken(s)]
    if not bad:
        return None
    worst = max(bad, key=lambda s: s.ratio)
    return (
        f"{path}: does not tile along {' and '.join(s.axis for s in bad)}: the seam is a step of "
        f"{abs(factor) * worst.step:.2g} tile widths, {worst.ratio:.3g} times the interior's 99th "
        "percentile; --make-tileable mirror or --make-tileable blend closes it"
    )


def inversion_warning(fit: NormalFit | None, path: Path) -> str | None:
    """The warning that the normal map matches the inverted heights."""
    if fit is None or not fit.inverted:
        return None
    return (
        f"{path}: fits the heights only upside down (correlation of their slopes {min(fit.gl, fit.dx):.2f}); "
        "if dark is high, give a negative --height-scale"
    )


def choose_convention(
    fit: NormalFit | None, named: Convention | None, asked: Convention | None, path: Path
) -> tuple[Convention, str, str | None]:
    """(convention, its source, warning or None) of a normal map.

    The material file takes precedence over the data, the data over the file name; the default is OpenGL.
    """
    claim = asked or named
    shown = None if fit is None else fit.convention
    chosen: Convention = asked or shown or named or "gl"
    if asked and asked != shown:
        how = "as configured"
    elif shown:
        how = "as the heights' slopes show"
    else:
        how = "by its name" if named else "assumed: the heights do not decide"
    if fit is None or shown is None or claim is None or claim == shown:
        return chosen, how, None
    warning = (
        f"{path}: the {'convention in the material file' if asked else 'name'} implies "
        f"{CONVENTION_NAMES[claim]}, the heights' slopes imply {CONVENTION_NAMES[shown]} "
        f"(correlation {fit.as_is:.2f} against {min(fit.gl, fit.dx):.2f}); "
        f"read as {CONVENTION_NAMES[chosen]}"
    )
    return chosen, how, warning


def signed(correlation: float) -> str:
    """A correlation as text; NaN, where either has no slopes, as ``undefined``."""
    return "undefined" if math.isnan(correlation) else f"{correlation:+.2f}"


def far_off(factor: float, suggested: float) -> bool:
    """Whether a height scale is over 1.5 times, or under 1/1.5 of, the one that the normal map suggests."""
    return suggested != 0 and not 1 / _FAR_OFF <= factor / suggested <= _FAR_OFF


def suggestion_warning(path: Path, fit: NormalFit | None, factor: float) -> str | None:
    """The warning that the height scale in use is far off the one that the normal map suggests."""
    if fit is None or not fit.fits or not far_off(factor, fit.scale):
        return None
    ratio = factor / fit.scale
    return (
        f"{path}: the heights are {ratio:{'.0f' if abs(ratio) >= 10 else '.2g'}} times as steep as its "
        f"slopes ({factor:.3g} is in use); add --height-scale {fit.scale:.3g} to agree"
    )


def normal_note(path: Path, fit: NormalFit | None, convention: Convention, how: str) -> str:
    """Convention of a normal map, its correlation with the heights, and the height scale it suggests."""
    text = f"normal map: {path.name}, {CONVENTION_NAMES[convention]}, {how}"
    if fit is None:
        return text
    v = fit.correlation_v if convention == "gl" else -fit.correlation_v
    text += f"; correlation of the slopes u {signed(fit.correlation_u)}, v {signed(v)}"
    return f"{text}; suggested --height-scale {fit.scale:.3g}" if fit.fits else text


# Fraction of texels at either end of the histogram that is ignored, because rare codes leave gaps.
_TAIL = 0.005
# Fewer levels are treated as an intentionally terraced or binary surface.
_FEWEST = 16
# Codes of a stretched histogram lie this close to a straight line over their rank: rounding, and a little.
_STRAIGHT = 0.75


@dataclass(frozen=True)
class Codes:
    """Distribution of the integer codes of a height map.

    Attributes
    ----------
    levels : number of different codes
    low, high : smallest and largest code
    spacing : distance of neighboring levels in codes; 1 unless the histogram was stretched
    """

    levels: int
    low: int
    high: int
    spacing: float

    @property
    def rounding(self) -> float:
        """Step, in codes, of the rounding that the heights went through.

        A histogram stretched by a factor f was rounded twice, to f codes and to one, so the variance is
        (f² + 1)/12, that of a step √(f² + 1); a whole f needs no second rounding.
        """
        whole = abs(self.spacing - round(self.spacing)) < 1e-6
        return self.spacing if whole else math.hypot(self.spacing, 1.0)


def code_use(codes: NDArray[Any]) -> Codes:
    """Levels and spacing of integer codes (H, W).

    The spacing is the slope of the least-squares line through the used codes over their rank, between the
    0.5th and the 99.5th percentile of the texels, if all of these codes lie within 0.75 of the line; else 1.
    """
    used, counts = np.unique(codes, return_counts=True)
    used = used.astype(np.int64)
    levels, low, high = len(used), int(used[0]), int(used[-1])
    below = np.cumsum(counts) / counts.sum()
    inner = used[(below > _TAIL) & (below - counts / counts.sum() < 1.0 - _TAIL)]
    spacing = 1.0
    if levels >= _FEWEST and len(inner) >= _FEWEST:
        rank = np.arange(len(inner), dtype=np.float64)
        slope, offset = np.polyfit(rank, inner.astype(np.float64), 1)
        if np.abs(inner - offset - slope * rank).max() <= _STRAIGHT:
            spacing = float(round(slope) if abs(slope - round(slope)) < 1e-3 else slope)
    return Codes(levels, low, high, max(1.0, spacing))
