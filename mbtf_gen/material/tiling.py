"""Detection of seams, and methods that make maps tileable.

The tile is periodic, so a map whose last column does not continue in its first one has a cliff per period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

# Share of the tile, at each edge, over which `blend` cross-fades.
BAND = 0.125
# A seam this many times the interior's 99th percentile is reported.
_LIMIT = 1.5
# Lines along an axis below which no percentile of the interior exists.
_FEWEST = 16
# Slopes are taken from normals no closer to the plane than this.
_FLATTEST = 0.01


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


def blend(image: Array) -> Array:
    """Cross-fade at all edges, same shape (H, W, ...).

    Along each axis the map is mixed with itself shifted by half a tile, which runs on smoothly where the map
    has its seam: ``w(x)·f(x) + (1-w(x))·f(x+½)``, w rising from 0 at the edges to 1 over an eighth of the
    tile (smoothstep). Maps of any resolution are treated alike; odd sizes interpolate the half texel.
    """
    out = np.asarray(image, np.float64)
    for axis in (0, 1):
        size = out.shape[axis]
        edge = np.minimum(np.arange(size) + 0.5, size - np.arange(size) - 0.5) / size
        x = np.clip(edge / BAND, 0.0, 1.0)
        w = (x * x * (3.0 - 2.0 * x)).reshape(-1, *[1] * (out.ndim - 1 - axis))
        half = size // 2
        other = 0.5 * (np.roll(out, half, axis) + np.roll(out, size - half, axis))
        out = w * out + (1.0 - w) * other
    return out.astype(image.dtype)


def mirror_normals(normal: NDArray[np.float32]) -> NDArray[np.float32]:
    """:func:`mirror` of unit vectors (H, W, 3), x along u and y along v: the mirrored axis changes sign."""
    rows, columns = normal.shape[:2]
    out = mirror(normal).astype(np.float32)
    out[:, columns:, 0] *= -1.0
    out[rows:, ..., 1] *= -1.0
    return out


def blend_normals(normal: NDArray[np.float32]) -> NDArray[np.float32]:
    """:func:`blend` of unit vectors (H, W, 3): their slopes are mixed, as the heights' own are.

    The slope that the cross-fade itself gives the heights is not in it: that is the mesh's.
    """
    n = normal.astype(np.float64)
    slopes = blend(n[..., :2] / np.maximum(n[..., 2:], _FLATTEST))
    up = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    return (up / np.linalg.norm(up, axis=-1, keepdims=True)).astype(np.float32)


def retile(maps: Mapping[str, Any], tile: Literal["mirror", "blend"]) -> dict[str, Any]:
    """Mirror or blend maps by role; constants and None are unchanged.

    Lengths are in tile widths. A mirrored tile is two images wide, so its heights are halved: the shape of
    the surface stays.

    Parameters
    ----------
    maps : role → (H, W), (H, W, 3), a constant, or None; ``normal`` holds unit vectors, ``height`` lengths
    """
    change, turn = (mirror, mirror_normals) if tile == "mirror" else (blend, blend_normals)
    out = {role: change(value) if np.ndim(value) >= 2 else value for role, value in maps.items()}
    if maps["normal"] is not None:
        out["normal"] = turn(maps["normal"])
    if tile == "mirror":
        out["height"] = 0.5 * out["height"]
    return out
