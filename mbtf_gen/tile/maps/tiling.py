"""Detection of seams, and methods that make maps tileable.

The tile is periodic, so a map whose last column does not continue in its first one has a cliff per period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.tile.maps.blending import blend_maps

Array = NDArray[np.floating[Any]]

# A seam this many times the interior's 99th percentile is reported.
_LIMIT = 1.5
# Lines along an axis below which no percentile of the interior exists.
_FEWEST = 16


@dataclass(frozen=True)
class Seam:
    """Seam of a height map (H, W) along one axis, in stored heights.

    The step between two neighboring lines (columns for the axis u, rows for v) is the root mean square of
    their difference.

    Attributes
    ----------
    axis : "u" or "v"
    step : step across the seam, between the last and the first line
    interior : 99th percentile of the steps between neighboring lines inside the map
    """

    axis: Literal["u", "v"]
    step: float
    interior: float

    @property
    def ratio(self) -> float:
        """Seam step over interior step; at most 1 where the seam is not visible."""
        return self.step / self.interior if self.interior > 0 else (0.0 if self.step == 0 else float("inf"))


def seams(height: Array, rounding: float = 0.0) -> tuple[Seam, ...]:
    """Seams of heights (H, W) along u and v; axes of fewer than 16 lines are left out.

    Parameters
    ----------
    rounding : step that heights were rounded to; no interior step counts as less
    """
    out = []
    axes: tuple[tuple[Literal["u", "v"], int], ...] = (("u", 1), ("v", 0))
    for name, axis in axes:
        if height.shape[axis] >= _FEWEST:
            # The step behind the last line is the seam's.
            steps = np.sqrt(np.mean((np.roll(height, -1, axis) - height) ** 2, axis=1 - axis))
            interior = max(float(np.percentile(steps[:-1], 99)), rounding)
            out.append(Seam(name, float(steps[-1]), interior))
    return tuple(out)


def broken(seam: Seam) -> bool:
    """Is the seam's step more than 1.5 times the interior's 99th percentile?"""
    return seam.ratio > _LIMIT


def mirror(image: Array) -> Array:
    """Two by two copies, (2H, 2W, ...), every other one mirrored, so that all edges meet."""
    top = np.concatenate([image, np.flip(image, 1)], axis=1)
    return np.concatenate([top, np.flip(top, 0)], axis=0)


def mirror_normals(normal: NDArray[np.float32]) -> NDArray[np.float32]:
    """:func:`mirror` of unit vectors (H, W, 3), x along u and y along v: the mirrored axis changes sign."""
    rows, columns = normal.shape[:2]
    out = mirror(normal).astype(np.float32)
    out[:, columns:, 0] *= -1.0
    out[rows:, ..., 1] *= -1.0
    return out


def retile(maps: Mapping[str, Any], tile: Literal["mirror", "blend"]) -> dict[str, Any]:
    """Mirror or blend maps by role; constants and None are unchanged.

    Lengths are in tile widths. A mirrored tile is two images wide, so its heights are halved: the shape of
    the surface stays.

    Parameters
    ----------
    maps : role → (H, W), (H, W, 3), a constant, or None; ``normal`` holds unit vectors, ``height`` lengths
    """
    if tile == "blend":
        return blend_maps(maps)
    out = {role: mirror(value) if np.ndim(value) >= 2 else value for role, value in maps.items()}
    if maps.get("normal") is not None:
        out["normal"] = mirror_normals(maps["normal"])
    out["height"] = 0.5 * out["height"]
    return out
