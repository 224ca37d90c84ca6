"""Detection of seams, and methods that make maps tileable.

The tile is periodic, so a map whose last column does not continue in its first one has a cliff per period.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mbtf_core.images.resample import resample

Array = NDArray[np.floating[Any]]

# A seam this many times the interior's 99th percentile is reported.
_LIMIT = 1.5
# Lines along an axis below which no percentile of the interior exists.
_FEWEST = 16
# Lines that are compared at once.
_BLOCK = 256


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
            steps = _steps(np.moveaxis(height, axis, 0))
            interior = max(float(np.percentile(steps[:-1], 99)), rounding)
            out.append(Seam(name, float(steps[-1]), interior))
    return tuple(out)


def _steps(lines: Array) -> NDArray[np.float64]:
    """Root mean square of the step from each line (first axis) to the next one, in blocks that fit memory."""
    size = len(lines)
    out = np.empty(size)
    for start in range(0, size, _BLOCK):
        stop = min(start + _BLOCK, size)
        block = lines[np.arange(start, stop + 1) % size]
        out[start:stop] = np.sqrt(np.mean(np.diff(block, axis=0) ** 2, axis=1))
    return out


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


Floats = NDArray[np.float64]

# Share of the tile, at each edge, over which maps are mixed.
BAND = 0.125
# The shift is a multiple of this share of the tile.
_STEP = 1 / 256
# Lower bound of the correlation: it bounds the amplification where the copies cancel.
_LEAST_CORRELATION = -0.5
# Slopes are taken from normals no closer to the plane than this.
_FLATTEST = 0.01


@dataclass
class _Layer:
    """A map while it is blended: (H, W, C), and the sorted values of each channel where ranks are mixed."""

    values: Floats
    histogram: Floats | None = None

    @classmethod
    def of_ranks(cls, image: Floats) -> _Layer:
        from scipy.special import ndtri
        from scipy.stats import rankdata

        flat = image.reshape(-1, image.shape[-1])
        ranks = rankdata(flat, axis=0)
        return cls(ndtri((ranks - 0.5) / len(flat)).reshape(image.shape), np.sort(flat, axis=0))

    def result(self) -> Floats:
        if self.histogram is None:
            return self.values
        from scipy.special import ndtr

        ranks = ndtr(self.values) * len(self.histogram) - 0.5
        at = np.arange(len(self.histogram))
        channels = [np.interp(ranks[..., c], at, self.histogram[:, c]) for c in range(ranks.shape[-1])]
        return np.stack(channels, axis=-1)


def blend_maps(maps: Mapping[str, Any]) -> dict[str, Any]:
    """Blend the edges of maps of one tile, so that all of them tile; constants and None are unchanged.

    All maps have the same shift: the one for which the heights (or the first map, where those are constant)
    are most alike within the blended bands. So repeated structures such as stitches continue.

    Parameters
    ----------
    maps : (H, W) or (H, W, C) by role, of any resolutions. ``height`` keeps its mean and variance, ``normal``
        (unit vectors, x along u and y along v) those of its slopes, all others their histograms. Normals do
        not contain the slope that the weights themselves give the heights: the mesh has it.
    """
    images = {role: np.asarray(value) for role, value in maps.items() if np.ndim(value) >= 2}
    layers = {role: _layer(role, image) for role, image in images.items()}
    guide = next((role for role in ("height", *layers) if role in layers and np.ptp(images[role]) > 0), None)
    if guide is None:
        return dict(maps)
    for axis in (0, 1):
        shift = _shift(layers[guide].values, axis)
        normals = None
        for role, layer in layers.items():
            if role != "normal":
                layer.values, correlation = _mixed(layer.values, axis, shift)
                normals = correlation if role == "height" else normals
        if "normal" in layers:
            layers["normal"].values, _ = _mixed(layers["normal"].values, axis, shift, normals)
    out = dict(maps)
    for role, layer in layers.items():
        values = layer.result()
        if role == "normal":
            values = np.concatenate([values, np.ones((*values.shape[:2], 1))], axis=-1)
            values /= np.linalg.norm(values, axis=-1, keepdims=True)
        out[role] = values.reshape(images[role].shape).astype(images[role].dtype)
    return out


def _layer(role: str, image: NDArray[Any]) -> _Layer:
    values = image.astype(np.float64).reshape(*image.shape[:2], -1)
    if role == "height":
        return _Layer(values)
    if role == "normal":
        return _Layer(values[..., :2] / np.maximum(values[..., 2:], _FLATTEST))
    return _Layer.of_ranks(values)


def _weights(size: int, axis: int) -> Floats:
    """Weight of the unshifted map along an axis: 0 at the edges, 1 from the band on (smoothstep)."""
    center = (np.arange(size) + 0.5) / size
    x = np.clip(np.minimum(center, 1.0 - center) / BAND, 0.0, 1.0)
    return np.expand_dims(x * x * (3.0 - 2.0 * x), (1, 2) if axis == 0 else (0, 2))


def _shifted(image: Floats, axis: int, shift: float) -> Floats:
    """The map shifted by a share of the tile: whole texels exactly, parts of them by cubic splines."""
    texels = shift * image.shape[axis]
    if texels == round(texels):
        return np.roll(image, round(texels), axis)
    from scipy.ndimage import shift as interpolate

    offset = np.zeros(3)
    offset[axis] = texels
    return interpolate(image, offset, order=3, mode="grid-wrap")


def _correlation(f: Floats, g: Floats, mean: Floats, weight: Floats) -> Floats:
    """Correlation of each channel (C,) where the weight is below 1; 0 where a channel is constant."""
    rows, columns, _ = np.broadcast_shapes(weight.shape, f.shape)
    inside = np.broadcast_to(weight[..., 0] < 1.0, (rows, columns))
    a, b = f[inside] - mean, g[inside] - mean
    norm = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    return np.clip((a * b).sum(axis=0) / np.where(norm > 0, norm, np.inf), _LEAST_CORRELATION, 1.0)


def _mixed(
    image: Floats, axis: int, shift: float, correlation: Floats | None = None
) -> tuple[Floats, Floats]:
    """The map mixed with its shifted copy along one axis, and the correlation of both."""
    mean = image.mean(axis=(0, 1))
    w = _weights(image.shape[axis], axis)
    other = _shifted(image, axis, shift)
    rho = _correlation(image, other, mean, w) if correlation is None else correlation
    norm = np.sqrt(w**2 + (1.0 - w) ** 2 + 2.0 * rho * w * (1.0 - w))
    mixed = mean + (w * (image - mean) + (1.0 - w) * (other - mean)) / norm
    return np.where(w < 1.0, mixed, image), rho


def _shift(image: Floats, axis: int) -> float:
    """The share of the tile by which a shifted map is most like itself within the bands.

    The seam of the shifted map lies outside both bands.
    """
    gray = image.mean(axis=-1, keepdims=True)
    cells = round(1 / _STEP)
    rows, columns = (min(size, cells) if k != axis else cells for k, size in enumerate(gray.shape[:2]))
    small = resample(gray[..., 0], rows, columns).astype(np.float64)[..., None]
    mean, w = small.mean(axis=(0, 1)), _weights(cells, axis)
    shifts = np.arange(round(2 * BAND * cells), cells - round(2 * BAND * cells) + 1)
    alike = [_correlation(small, np.roll(small, s, axis), mean, w)[0] for s in shifts]
    # Of equally good shifts, the one closest to half a tile.
    order = np.lexsort((np.abs(shifts - cells // 2), -np.round(alike, 9)))
    return float(shifts[order[0]]) * _STEP
