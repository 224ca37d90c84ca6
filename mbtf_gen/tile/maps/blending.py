"""Blending the edges of maps, so that a tile continues in its copies.

Along each axis the maps are mixed with themselves, shifted so far that they run on smoothly where they have
their seam. A plain cross-fade of two uncorrelated textures loses up to half of their variance, and a tile
shows it as smoother, brighter lines. The mean m and the variance are therefore kept (Heitz and Neyret 2018,
"High-Performance By-Example Noise using a Histogram-Preserving Blending Operator", section 3):

    m + [w (f - m) + (1 - w) (g - m)] / sqrt(w² + (1 - w)² + 2 ρ w (1 - w))

with the shifted map g and its correlation ρ with f where both are mixed (0 in the paper). Heights are blended
as they are, and slopes of normals with the weights of the heights; colors and shares are given normal
distributions before (by their ranks) and their own histograms afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.images.resample import resample

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
    maps : mapping of str to array, float or None
        (H, W) or (H, W, C) by role, of any resolutions. ``height`` keeps its mean and variance, ``normal``
        (unit vectors, x along u and y along v) those of its slopes, all others their histograms. Normals do
        not contain the slope that the weights themselves give the heights: the mesh has it.

    Returns
    -------
    dict of str to array, float or None
        Maps of the same shapes and types.
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
