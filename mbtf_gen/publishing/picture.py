"""The picture of a card: the tile and its heights, drawn from the stored numbers alone.

Queries lie uniformly on the tile. Averages over directions from above are therefore pictures of the tile.
Nothing is rendered.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import ALBEDO_EXPOSURE, to_display
from mbtf_core.data.geometry import Geometry
from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored, write_through
from mbtf_gen.publishing.facts import mean_of

F64 = NDArray[np.float64]
PICTURE_NAME = "contact_sheet.png"
# Smallest cosine of views in the picture of the tile: parallax would blur it.
_FROM_ABOVE = 0.85
# Pixels across a panel, queries that its smoothing averages, its largest standard deviation in tile widths.
_ACROSS, _PER_WINDOW, _WIDEST = 192, 32, 0.1
# Share of the queries, those with the finest footprints, that is shown at least.
_FINEST = 0.2
# What is shown where there is no query.
_EMPTY = 238


def tile_image(arrays: Arrays, aspect: float) -> F64:
    """Mean value by position as seen from above, under all lights.

    An image (rows, columns, 3) in 1/sr, row 0 at ``v → 1``, of a tile of this height over its width, smoothed
    as wide as few queries require; NaN where there are none. Values over white and over 99% of the others are
    clipped: a highlight that few queries see would be a speck.
    """
    value = np.asarray(mean_of(arrays), np.float64).reshape(-1, 3)
    value = np.minimum(value, max(2.0**-ALBEDO_EXPOSURE, np.quantile(value, 0.99, axis=0).max()))
    u, sigma = (np.asarray(arrays[k], np.float64) for k in ("u", "sigma"))
    u, sigma = u.reshape(-1, 2), sigma.reshape(-1)
    found = arrays["omega_o"].reshape(-1, 3)[:, 2] > _FROM_ABOVE
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


def displayed(image: F64) -> NDArray[np.uint8]:
    """8-bit sRGB of an image (..., 3) that keeps albedos; pixels without queries are light gray."""
    known = np.asarray(np.isfinite(image).all(axis=-1))
    shown = to_display(np.where(known[..., None], image, 0.0), ALBEDO_EXPOSURE)
    shown[~known] = _EMPTY
    return shown


def write_picture(arrays: Arrays, aspect: float, geometry: Geometry | None, path: Path) -> Stored:
    """Write the contact sheet of training queries and of a geometry as a PNG, atomically."""
    from matplotlib.figure import Figure

    panels, extent = 1 if geometry is None else 2, (0, 1, 0, aspect)
    figure = Figure(figsize=(3.0 * panels, 3.3), layout="constrained")
    axes: Any = figure.subplots(1, panels, squeeze=False)[0]
    axes[0].imshow(displayed(tile_image(arrays, aspect)), extent=extent, interpolation="nearest")
    axes[0].set(title="the tile, all lights", xticks=(), yticks=())
    if geometry is not None:
        shown = axes[1].imshow(geometry.heights, extent=extent, cmap="gray")
        axes[1].set(title="heights in tile widths", xticks=(), yticks=())
        figure.colorbar(shown, ax=axes[1], shrink=0.8)
    return write_through(path, partial(figure.savefig, format="png", dpi=100))
