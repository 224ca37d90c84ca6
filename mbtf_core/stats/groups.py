"""Statistics by group: levels of detail, elevation bands, any integer label."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.lattice import level_of_sigma
from mbtf_core.directions import ELEVATION_BANDS
from mbtf_core.stats.estimate import Estimate


def by_group(function: Callable[..., Estimate], groups: ArrayLike, *arrays: ArrayLike) -> dict[int, Estimate]:
    """Evaluate a statistic per group: ``by_group(noise_free_mse, level_groups(sigma), p, a, b)``.

    Parameters
    ----------
    function : A function of this package that takes arrays and returns an Estimate
    groups : (n,) int array_like
        Labels; rows with negative labels are ignored.
    *arrays : (n, ...) array_like
        Arguments of the function.

    Returns
    -------
    dict of int to Estimate
        Estimate of each group from its own rows, by ascending label.
    """
    labels = group_labels(groups, len(np.asarray(arrays[0])))
    rows = [np.asarray(array) for array in arrays]
    return {
        int(label): function(*(array[labels == label] for array in rows))
        for label in np.unique(labels[labels >= 0])
    }


def group_labels(groups: ArrayLike, n: int) -> NDArray[np.int64]:
    """Labels as an (n,) integer array.

    Raises
    ------
    ValueError : another length, or not integers
    """
    labels = np.asarray(groups)
    if labels.shape != (n,) or not np.issubdtype(labels.dtype, np.integer):
        raise ValueError(f"groups must be {n} integers, not {labels.dtype} of shape {labels.shape}")
    return labels.astype(np.int64)


def level_groups(sigma: ArrayLike, finest: int | None = None) -> NDArray[np.int64]:
    """Label footprints with their nearest level, ``round(-log2(2σ))``.

    Parameters
    ----------
    sigma : standard deviations in tile widths, any shape
    finest : labels are clamped to 0..finest
    """
    level = np.rint(level_of_sigma(sigma)).astype(np.int64)
    return np.clip(level, 0, finest)


def elevation_groups(*omegas: ArrayLike, edges: tuple[float, ...] = ELEVATION_BANDS) -> NDArray[np.int64]:
    """Label queries with the elevation band of their most grazing direction.

    Parameters
    ----------
    *omegas : (n, 3) array_like
        Unit vectors, such as ω_i and ω_o.
    edges : band i is ``edges[i] ≤ cos θ < edges[i+1]``; the last band includes its upper edge

    Returns
    -------
    (n,) int64 array
    """
    cosine = np.min([np.asarray(w, np.float64)[..., 2] for w in omegas], axis=0)
    return np.clip(np.searchsorted(edges, cosine, side="right") - 1, 0, len(edges) - 2).astype(np.int64)
