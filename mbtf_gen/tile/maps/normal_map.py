"""Comparison of a normal map with its height map: convention, scale.

A normal map usually repeats the slopes of its height map. We compare the slopes of the normals,
``t = (-n_x/n_z, -n_y/n_z)``, with those of the heights, ``s = (∂h/∂u, ∂h/∂y)``, y = a·v. Their correlation
over all texels and both components, ``Σ s·t / √(Σ s² Σ t²)``, is near 1 where they agree. It also tells an
inverted green channel (DirectX) and inverted heights.

Some maps store x and y alone: two-channel compression (BC5), and x in alpha, y in green (DXT5nm).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.images.resample import resample
from mbtf_gen.tile.heights import HeightGrid, height_slopes, normal_slopes
from mbtf_gen.tile.maps.file_names import Convention

Array = NDArray[np.floating[Any]]

# Texels across, at most, that decide, and that the scale is fitted at.
_COMPARED, _FITTED = 512, 2048
# Slopes of DirectX over those of OpenGL, along u and y.
_DX = np.array([1.0, -1.0])[:, None, None]
# The data decide where a correlation exceeds the first number and its rival by the second; of n texels, no
# less than chance allows (multiples of 1/√n).
_CLEAR, _AHEAD = (0.3, 8.0), (0.1, 4.0)
_FLATTEST = 0.1
_SMALLEST = 4
# Blue is no z where it differs from √(1 - x² - y²), on average, by more than its own standard deviation and
# this, which rounding explains, and correlates with it by less than the second number.
_ROUNDING, _UNRELATED = 0.005, 0.3
# Standard deviation of a constant channel, with the rounding of JPG images.
_CONSTANT = 0.02
# Blue of empty maps is below the first number: -1, and the rounding of JPG images. Gray blue (0) makes flat
# normals shorter than the second.
_EMPTY, _SHORT = -0.9, 0.1
# Texels that decide, about.
_DECIDING = 1 << 20


@dataclass(frozen=True)
class NormalFit:
    """Result of :func:`fit_normals`.

    Attributes
    ----------
    correlation_u, correlation_v : correlation of the slopes along u and along v, in the OpenGL convention;
        NaN where either has no slopes
    gl, dx : correlation over both components, in the OpenGL and the DirectX convention
    convention : {"gl", "dx"} or None, the convention with the clearly larger correlation; None if the data do
        not decide
    fits : whether the images clearly match
    inverted : whether they clearly match only with inverted heights
    scale : height scale in tile widths (signed) whose slopes fit the normals best in the better convention
        (least squares)
    """

    correlation_u: float
    correlation_v: float
    gl: float
    dx: float
    convention: Convention | None
    fits: bool
    inverted: bool
    scale: float

    @property
    def as_is(self) -> float:
        """Correlation in the better of the two conventions."""
        return max(self.gl, self.dx)


def slopes_of_heights(height: Array) -> Array:
    """Slopes (2, H-2, W-2) of heights (H, W) along u and y = a·v, in stored heights per tile width. The
    outermost texels are left out: heights need not tile."""
    grid = HeightGrid(np.asarray(height, np.float64), height.shape[0] / height.shape[1])
    return np.moveaxis(height_slopes(grid)[1:-1, 1:-1], -1, 0)


def slopes_of_normals(normal: Array) -> Array:
    """Slopes (2, H-2, W-2) along u and y that normals (H, W, 3) claim, their mean removed."""
    slopes = np.moveaxis(normal_slopes(normal[1:-1, 1:-1], _FLATTEST), -1, 0)
    return slopes - slopes.mean(axis=(1, 2), keepdims=True)


def fit_normals(height: Array, normal: Array) -> NormalFit | None:
    """Compare a normal map (h, w, 3), unit vectors with y along v, with the stored heights (H, W) of the same
    tile, both box-filtered to the coarser resolution. None if either is flat, or has fewer than 4 texels
    along a side."""
    fitted, (h, n) = (_common(height, normal, limit) for limit in (_FITTED, _COMPARED))
    if min(h.shape) < _SMALLEST:
        return None
    s, t = slopes_of_heights(fitted[0]), slopes_of_normals(fitted[1])
    if not _energy(s) > 0 or not _energy(t) > 1e-9 * t.size:
        return None
    stored, claimed = slopes_of_heights(h), slopes_of_normals(n)
    gl, dx = _correlation(stored, claimed), _correlation(stored, claimed * _DX)
    here, inverse = max(gl, dx), max(-gl, -dx)
    clear, ahead = (max(low, factor / math.sqrt(h.size)) for low, factor in (_CLEAR, _AHEAD))
    inverted = inverse >= clear and inverse - here >= ahead
    fits = here >= clear and not inverted
    better: Convention = "gl" if gl >= dx else "dx"
    return NormalFit(
        correlation_u=_correlation(s[0], t[0]),
        correlation_v=_correlation(s[1], t[1]),
        gl=gl,
        dx=dx,
        convention=better if fits and abs(gl - dx) >= ahead else None,
        fits=fits,
        inverted=inverted,
        scale=float((s * t * (1.0 if better == "gl" else _DX)).sum() / _energy(s)),
    )


def _common(height: Array, normal: Array, limit: int) -> tuple[Array, Array]:
    """Both at the coarser of their resolutions, of at most `limit` texels along a side."""
    rows, columns = (min(height.shape[axis], normal.shape[axis]) for axis in (0, 1))
    shrink = max(1.0, max(rows, columns) / limit)
    size = max(1, round(rows / shrink)), max(1, round(columns / shrink))
    return resample(height, *size), resample(normal, *size)


def _energy(slopes: Array) -> float:
    return float((slopes * slopes).sum())


def _correlation(s: Array, t: Array) -> float:
    norm = math.sqrt(_energy(s) * _energy(t))
    return float((s * t).sum()) / norm if norm > 0 else float("nan")


def stored_xy(vectors: Array) -> tuple[list[int], str] | None:
    """The channels of x and y in a normal map (H, W, C) that stores no z, and the same in words; None where
    the map stores z. Components are in [-1, 1]; of large maps, some decide.

    Blue is no z where it neither equals √(1 - x² - y²) nor varies with it. In such maps x is in alpha if red
    and blue are constant or equal green, and alpha is not constant.
    """
    if vectors.shape[2] == 2:
        return [0, 1], "x and y"
    step = max(1, round(math.sqrt(vectors[..., 0].size / _DECIDING)))
    vectors = vectors[::step, ::step]
    red, green, blue = (vectors[..., i] for i in range(3))
    z = height_of(vectors[..., :2])
    if float(np.mean(np.abs(z - blue))) <= _ROUNDING + float(blue.std()):
        return None
    alone = all(_constant(channel) or np.array_equal(channel, green) for channel in (red, blue))
    if alone and vectors.shape[2] == 4 and np.ptp(vectors[..., 3]) > 0:
        return [3, 1], "x in alpha and y in green"
    deviations = float(z.std()), float(blue.std())
    related = float(np.mean((z - z.mean()) * (blue - blue.mean()))) > _UNRELATED * math.prod(deviations)
    unrelated = deviations[0] > 0 and not (deviations[1] > 0 and related)
    if unrelated or blue.max() < _EMPTY or np.square(vectors[..., :3]).sum(axis=-1).max() < _SHORT**2:
        return [0, 1], "x in red and y in green"
    return None


def height_of(xy: Array) -> Array:
    """z = √(1 - x² - y²) of unit normals (H, W, 2) that point up; 0 where x² + y² exceeds 1."""
    return np.asarray(np.sqrt(np.maximum(0.0, 1.0 - np.square(xy).sum(axis=-1))))


def _constant(channel: Array) -> bool:
    return float(channel.std()) <= _CONSTANT
