"""The picture of a card: the tile, its apparent BRDF and its heights, drawn from the stored numbers alone.

Queries lie uniformly on the tile. Averages over all positions are therefore the tile mean, and those over
directions from above are pictures of the tile. Nothing is rendered.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import ALBEDO_EXPOSURE, to_display
from mbtf_core.data.geometry import Geometry
from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_gen.publishing.facts import mean_of

F64 = NDArray[np.float64]
PICTURE_NAME = "contact_sheet.png"
# Elevations of the lights of the BRDF, in degrees.
_ELEVATIONS = (35.0, 65.0)
# Smallest cosine of views in the picture of the tile: parallax would blur it.
_FROM_ABOVE = 0.85
# Pixels across a panel, queries that its smoothing averages, its largest standard deviation in tile widths.
_ACROSS, _PER_WINDOW, _WIDEST = 192, 32, 0.1
# Share of the queries, those with the finest footprints, that is shown at least.
_FINEST = 0.2
# Queries per pixel of the BRDF, and pixels across at least and at most.
_PER_PIXEL, _LEAST, _MOST = 48, 4, 128
# What is shown where there is no query.
_EMPTY = 238


def mean_image(x: F64, y: F64, value: F64, rows: int, columns: int) -> F64:
    """Mean value (rows, columns, 3) of points of the unit square, row 0 at ``y → 1``; NaN without points."""
    from scipy.stats import binned_statistic_2d

    unit = ((0.0, 1.0), (0.0, 1.0))
    found = binned_statistic_2d(1.0 - y, x, value.T, "mean", (rows, columns), unit).statistic
    return np.moveaxis(np.asarray(found), 0, -1)


def tile_image(arrays: Arrays, aspect: float) -> F64:
    """Mean value by position as seen from above, under all lights.

    An image (rows, columns, 3) in 1/sr, row 0 at ``v → 1``, of a tile of this height over its width, smoothed
    as wide as few queries require; NaN where there are none. Values over white and over 99% of the others are
    clipped: a highlight that few queries see would be a speck.
    """
    u, _, view, value = _queries(arrays)
    value = np.minimum(value, max(2.0**-ALBEDO_EXPOSURE, np.quantile(value, 0.99, axis=0).max()))
    sigma = np.asarray(arrays["sigma"], np.float64).reshape(-1)
    found = view[:, 2] > _FROM_ABOVE
    return _smoothed(u[found], sigma[found], value[found], aspect)


def _smoothed(u: F64, sigma: F64, value: F64, aspect: float) -> F64:
    """Mean value of queries by position, smoothed over a number of them on the torus."""
    from scipy.ndimage import gaussian_filter

    columns, rows = _ACROSS, max(1, round(aspect * _ACROSS))
    if len(u) == 0:
        return np.full((rows, columns, 3), np.nan)

    def width(count: int) -> float:
        # A Gaussian average has the variance of one over 4πσ² times the density of queries.
        return float(min(np.sqrt(_PER_WINDOW * aspect / (4.0 * np.pi * count)), _WIDEST))

    # Footprints that blur more than the smoothing are left out.
    sharp = sigma <= max(width(len(u)), float(np.quantile(sigma, _FINEST)))
    x, y = u[sharp].T
    weights = [np.ones(len(x)), *value[sharp].T]
    unit = ((0.0, 1.0), (0.0, 1.0))
    sums = np.stack([np.histogram2d(1.0 - y, x, (rows, columns), unit, weights=w)[0] for w in weights], -1)
    smooth = gaussian_filter(sums, columns * width(len(x)), mode="wrap", axes=(0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        image = np.where(smooth[..., :1] > 0, smooth[..., 1:] / smooth[..., :1], np.nan)
    return np.asarray(image)


def brdf_image(arrays: Arrays) -> F64:
    """Mean value (n, n, 3) over the tile by direction of view, of lights 35° to 65° above the plane, in 1/sr.

    Both directions are turned about the normal until the light lies on the right; y of ω_o is upwards.
    """
    _, light, view, value = _queries(arrays)
    elevation = np.degrees(np.arcsin(np.clip(light[:, 2], 0.0, 1.0)))
    found = (elevation >= _ELEVATIONS[0]) & (elevation <= _ELEVATIONS[1])
    light, view, value = light[found], view[found], value[found]
    cosine, sine = (light[:, :2] / np.hypot(*light[:, :2].T)[:, None]).T
    x, y = cosine * view[:, 0] + sine * view[:, 1], cosine * view[:, 1] - sine * view[:, 0]
    n = int(np.clip(np.sqrt(len(x) / _PER_PIXEL), _LEAST, _MOST))
    return mean_image(0.5 + 0.5 * x, 0.5 + 0.5 * y, value, n, n)


def _queries(arrays: Arrays) -> tuple[F64, F64, F64, F64]:
    """u, omega_i, omega_o and the value, one row per query."""
    value = np.asarray(mean_of(arrays), np.float64).reshape(-1, 3)
    u, light, view = (np.asarray(arrays[k], np.float64) for k in ("u", "omega_i", "omega_o"))
    return u.reshape(-1, 2), light.reshape(-1, 3), view.reshape(-1, 3), value


def displayed(image: F64) -> NDArray[np.uint8]:
    """8-bit sRGB of an image (..., 3) that keeps albedos; pixels without queries are light gray."""
    known = np.asarray(np.isfinite(image).all(axis=-1))
    shown = to_display(np.where(known[..., None], image, 0.0), ALBEDO_EXPOSURE)
    shown[~known] = _EMPTY
    return shown


def write_picture(arrays: Arrays, aspect: float, geometry: Geometry | None, path: Path) -> Stored:
    """Write the contact sheet of training queries and of a geometry as a PNG, atomically."""
    from matplotlib.figure import Figure

    panels = [
        ("the tile, all lights", tile_image(arrays, aspect), (0, 1, 0, aspect)),
        ("apparent BRDF by ω_o", brdf_image(arrays), (-1, 1, -1, 1)),
    ]
    figure = Figure(figsize=(3.0 * (len(panels) + (geometry is not None)), 3.3), layout="constrained")
    axes: Any = figure.subplots(1, len(panels) + (geometry is not None))
    for at, (title, image, extent) in zip(axes, panels, strict=False):
        at.imshow(displayed(image), extent=extent, interpolation="nearest")
        at.set(title=title, xticks=(), yticks=())
    if geometry is not None:
        shown = axes[-1].imshow(geometry.heights, extent=(0, 1, 0, aspect), cmap="gray")
        axes[-1].set(title="heights in tile widths", xticks=(), yticks=())
        figure.colorbar(shown, ax=axes[-1], shrink=0.8)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100)
    return write_chunks(path, [stream.getvalue()])
