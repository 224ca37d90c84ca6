"""Averages of stored values that are pictures: the tile under some lights, and its apparent BRDF.

Queries lie uniformly on the tile. Averages over all positions are therefore the tile mean, whatever the
footprints, and those over directions at fine footprints are pictures of the tile. Nothing is rendered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import level_of_sigma
from mbtf_gen.measured.exported import mean_of
from mbtf_gen.publishing.statistics import blocks

F64 = NDArray[np.float64]

# Sectors of the light's azimuth in pictures of the tile; None: all lights.
LIGHTS: dict[str, tuple[float, float] | None] = {
    "all lights": None,
    "light from the left": (-1.0, 0.0),
    "light from the right": (1.0, 0.0),
    "light from the top": (0.0, 1.0),
}
# Elevations of the light in pictures of the BRDF, in degrees.
ELEVATIONS: tuple[tuple[float, float], ...] = ((60.0, 90.0), (40.0, 60.0), (0.0, 40.0))
# Directions of a sector: within 60 degrees of azimuth, and below 75 degrees.
_SECTOR, _LOW = 0.5, 0.26
# Smallest cosine of views in pictures of the tile: parallax would blur it.
_FROM_ABOVE = 0.85
# Queries per pixel that a picture needs, and its largest number of pixels across. Where queries share
# directions, their mean has little noise.
_TILE_QUERIES, _BRDF_QUERIES, _BRDF_SHARED = 64, 96, 2
_MOST_TEXELS, _LEAST_BINS, _MOST_BINS = 256, 4, 64
# Queries that a pixel of the tile averages, those of its neighbors included.
_SMOOTHED_QUERIES = 48


@dataclass(frozen=True)
class Averages:
    """Pictures of averages; pixels without queries are NaN.

    Attributes
    ----------
    tile : (lights, rows, columns, 3) array
        Mean value over the lights of each entry of ``LIGHTS``, from views around the normal; row 0 at
        ``v → 1``.
    brdf : (elevations, bins, bins, 3) array
        Mean value over the tile by the direction of view. The light lies on the right (azimuth 0) at each of
        ``ELEVATIONS``. Column and row count from -1 to 1 in x and from 1 to -1 in y.
    """

    tile: F64
    brdf: F64


class _Bins:
    """Sums and counts of values in numbered bins."""

    def __init__(self, *shape: int) -> None:
        self.shape = shape
        size = int(np.prod(shape))
        self.sums, self.counts = np.zeros((size, 3)), np.zeros(size)

    def add(self, first: int, index: NDArray[np.int64], value: F64) -> None:
        """Add values (n, 3) to bins (n,) of the picture number `first`."""
        each = int(np.prod(self.shape[1:]))
        part = slice(first * each, (first + 1) * each)
        self.counts[part] += np.bincount(index, minlength=each)
        for channel in range(3):
            self.sums[part, channel] += np.bincount(index, value[:, channel], each)

    def means(self) -> F64:
        """Mean of each bin, NaN where it is empty."""
        return _ratio(self.sums, self.counts).reshape(*self.shape, 3)

    def smoothed_means(self) -> F64:
        """Means of the bins of periodic pictures, each with a Gaussian that is as wide as its noise needs."""
        from scipy.ndimage import gaussian_filter

        out = []
        for sums, counts in zip(
            self.sums.reshape(*self.shape, 3), self.counts.reshape(self.shape), strict=True
        ):
            mean = float(counts.mean())
            if 0 < mean < _SMOOTHED_QUERIES:
                # A Gaussian of σ pixels averages 4πσ² pixels.
                width = math.sqrt(_SMOOTHED_QUERIES / mean / (4 * math.pi))
                counts = gaussian_filter(counts, width, mode="wrap")
                sums = gaussian_filter(sums, (width, width, 0), mode="wrap")
            out.append(_ratio(sums, counts))
        return np.stack(out)


def _ratio(sums: F64, counts: F64) -> F64:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums / counts[..., None])


def directions_count(data: Dataset) -> int:
    """Number of pairs of directions in the training split: those of its queries, images or slices."""
    manifest = data.manifest
    rows = sum(entry.rows for entry in data.entries("train"))
    return int(manifest["slice_size"]) if data.layout == "slices" else rows


def tile_shape(data: Dataset) -> tuple[int, int]:
    """(rows, columns) of a picture of the tile: of the finest level with enough queries per texel."""
    lattice, queries = data.lattice, int(data.manifest["splits"]["train"]["queries"])
    levels = range(lattice.finest, -1, -1)
    fitting = (
        lattice.shape(level)
        for level in levels
        if max(lattice.shape(level)) <= _MOST_TEXELS and lattice.texels(level) * _TILE_QUERIES <= queries
    )
    return next(fitting, lattice.shape(0))


def brdf_bins(data: Dataset) -> int:
    """Bins across a picture of the BRDF."""
    needed = _BRDF_QUERIES if data.layout == "shuffled" else _BRDF_SHARED
    each = directions_count(data) / (len(ELEVATIONS) * needed)
    return int(np.clip(np.sqrt(each), _LEAST_BINS, _MOST_BINS)) // 2 * 2 + 1


def averages(data: Dataset) -> Averages:
    """Averages of the training queries.

    Parameters
    ----------
    data : Dataset
        A complete data set.

    Returns
    -------
    Averages

    Raises
    ------
    InputError
        A shard cannot be read.
    """
    rows, columns = tile_shape(data)
    bins = brdf_bins(data)
    tile, brdf = _Bins(len(LIGHTS), rows, columns), _Bins(len(ELEVATIONS), bins, bins)
    coarsest = np.log2(columns) - 0.5
    for shard in data.shards("train"):
        for arrays in blocks(shard.read()):
            value = mean_of(arrays).reshape(-1, 3).astype(np.float64)
            light, view = (arrays[n].reshape(-1, 3).astype(np.float64) for n in ("omega_i", "omega_o"))
            _add_brdf(brdf, bins, light, view, value)
            fine = (level_of_sigma(arrays["sigma"].reshape(-1)) >= coarsest) & (view[:, 2] > _FROM_ABOVE)
            u = arrays["u"].reshape(-1, 2)[fine]
            i = np.minimum((u[:, 0] * columns).astype(np.int64), columns - 1)
            j = rows - 1 - np.minimum((u[:, 1] * rows).astype(np.int64), rows - 1)
            _add_tile(tile, j * columns + i, light[fine], value[fine])
    return Averages(tile.smoothed_means(), brdf.means())


def _add_tile(tile: _Bins, texel: NDArray[np.int64], light: F64, value: F64) -> None:
    for number, sector in enumerate(LIGHTS.values()):
        if sector is None:
            tile.add(number, texel, value)
            continue
        across = np.hypot(light[:, 0], light[:, 1])
        towards = light[:, :2] @ np.array(sector)
        found = (across > _LOW) & (towards > _SECTOR * across)
        tile.add(number, texel[found], value[found])


def _add_brdf(brdf: _Bins, bins: int, light: F64, view: F64, value: F64) -> None:
    across = np.hypot(light[:, 0], light[:, 1])
    # Both directions are turned about the normal until the light lies at azimuth 0.
    cosine = np.divide(light[:, 0], across, out=np.ones_like(across), where=across > 0)
    sine = np.divide(light[:, 1], across, out=np.zeros_like(across), where=across > 0)
    x = cosine * view[:, 0] + sine * view[:, 1]
    y = cosine * view[:, 1] - sine * view[:, 0]
    column, row = (np.clip(np.floor((0.5 + 0.5 * c) * bins), 0, bins - 1).astype(np.int64) for c in (x, -y))
    elevation = np.degrees(np.arcsin(np.clip(light[:, 2], -1.0, 1.0)))
    for number, (low, high) in enumerate(ELEVATIONS):
        found = (elevation >= low) & (elevation <= high if high == 90.0 else elevation < high)
        brdf.add(number, (row * bins + column)[found], value[found])
