"""The picture of a card: the tile, its apparent BRDF and its heights, drawn from the stored numbers alone.

Queries lie uniformly on the tile. Averages over all positions are therefore the tile mean, and those over
directions are pictures of the tile. Nothing is rendered.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.color import ALBEDO_EXPOSURE, to_display
from mbtf_core.data.geometry import Geometry
from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.data.shard_files import Arrays
from mbtf_core.files.atomic import Stored, write_chunks
from mbtf_gen.measured.exported import mean_of

F64 = NDArray[np.float64]
PICTURE_NAME = "contact_sheet.png"
# Panels of the tile: the side that lights come from; (0, 0) takes all.
_SIDES = {"all lights": (0, 0), "light from the left": (-1, 0), "light from the top": (0, 1)}
# Queries per pixel, and pixels across at least and at most.
_PER_PIXEL, _LEAST, _MOST = 48, 4, 128
# Smallest cosine of views in panels of the tile, as parallax blurs it; elevations of the light of the BRDF.
_FROM_ABOVE, _ELEVATIONS = 0.85, (35.0, 65.0)
# What is shown where there is no query.
_EMPTY = 238


def mean_image(x: F64, y: F64, value: F64, rows: int, columns: int) -> F64:
    """Mean value (rows, columns, 3) of points of the unit square, row 0 at ``y → 1``; NaN without points."""
    from scipy.stats import binned_statistic_2d

    unit = ((0.0, 1.0), (0.0, 1.0))
    found = binned_statistic_2d(1.0 - y, x, value.T, "mean", (rows, columns), unit).statistic
    return np.moveaxis(np.asarray(found), 0, -1)


def tile_images(arrays: Arrays, aspect: float) -> dict[str, F64]:
    """Mean value by position, of views within 32° of the normal and of fine footprints, under some lights.

    Images (rows, columns, 3) in 1/sr by title, row 0 at ``v → 1``, of a tile of this height over its width.
    """
    u, light, view, value = _queries(arrays)
    above = view[:, 2] > _FROM_ABOVE
    sharp = level_of_sigma(arrays["sigma"].reshape(-1)) > 0.5
    above = above & sharp if (above & sharp).any() else above
    out = {}
    for title, side in _SIDES.items():
        found = above & (light[:, :2] @ side >= 0.5 * np.hypot(*light[:, :2].T) * np.hypot(*side))
        columns = int(np.clip(np.sqrt(found.sum() / _PER_PIXEL / aspect), _LEAST, _MOST))
        rows = max(1, round(aspect * columns))
        out[title] = mean_image(u[found, 0], u[found, 1], value[found], rows, columns)
    return out


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

    panels = [(title, image, (0, 1, 0, aspect)) for title, image in tile_images(arrays, aspect).items()]
    panels.append(("apparent BRDF by ω_o", brdf_image(arrays), (-1, 1, -1, 1)))
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
