"""Contrast of luminance and chroma of an image beside its reference.

A fit can have a small squared error and still look too smooth, or lose its colors. With the luminance L of a
value and the means over the reference, chroma is what a value has besides its share of the mean color:

    d = (R, G, B) - L · mean(R, G, B) / mean(L).

Contrasts are standard deviations over positions. Those of the reference, and correlations with it, use the
product of its independent halves, so noise biases neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.images.read import LUMINANCE
from mbtf_core.stats import Estimate

F64 = NDArray[np.float64]

# Least contrast of chroma over that of luminance for a material that counts as colored.
COLORED = 0.05
# Blocks along each axis of a picture that the jackknife leaves out: neighboring pixels are correlated.
BLOCKS = 8
DEFINITION = (
    "standard deviation over pixels of luminance L, and of chroma d = RGB - L mean(RGB) / mean(L), over that "
    "of the reference without its noise; correlation of chroma with the reference's. – where the chroma of "
    f"the reference has less than {100 * COLORED:g} % of its luminance's contrast. Error bars are a "
    f"jackknife over {BLOCKS} x {BLOCKS} blocks."
)


def contrast(
    values: ArrayLike, value_a: ArrayLike, value_b: ArrayLike, blocks: NDArray[np.int64]
) -> dict[str, Estimate | None]:
    """Contrast of values relative to that of a reference.

    Parameters
    ----------
    values : (n, 3) array_like
        Values of a fit, linear Rec.709.
    value_a, value_b : (n, 3) array_like
        Independent halves of the reference.
    blocks : (n,) int64 array
        Block of each position, from 0. Blocks are independent of each other.

    Returns
    -------
    dict
        ``luminance`` and ``chroma``: contrast over the reference's; ``correlation``: that of chroma. The
        latter two are None for a reference without color.
    """
    p, a, b = (np.asarray(x, np.float64) for x in (values, value_a, value_b))
    mean = 0.5 * (a + b).mean(0)
    weights = np.asarray(LUMINANCE)
    gray = mean / (mean @ weights)
    light = [(x @ weights)[:, None] for x in (p, a, b)]
    color = [x - y * gray for x, y in zip((p, a, b), light, strict=True)]
    of_light, of_color = _moments(light, blocks), _moments(color, blocks)
    colored = of_color.sum(0)[1] > COLORED**2 * of_light.sum(0)[1]
    return {
        "luminance": _jackknife(of_light, _ratio),
        "chroma": _jackknife(of_color, _ratio) if colored else None,
        "correlation": _jackknife(of_color, _correlation) if colored else None,
    }


def picture_blocks(rows: int, columns: int) -> NDArray[np.int64]:
    """Block (rows · columns) of each pixel of a picture."""
    along = [np.arange(n) * BLOCKS // n for n in (rows, columns)]
    return np.asarray(along[0][:, None] * BLOCKS + along[1], np.int64).reshape(-1)


def _moments(signals: Sequence[F64], blocks: NDArray[np.int64]) -> F64:
    """Sums (blocks, 3) of p², a·b and p·(a+b)/2 of centered signals (n, channels) p, a, b."""
    p, a, b = (x - x.mean(0) for x in signals)
    products = ((p * p).sum(1), (a * b).sum(1), (p * (a + b)).sum(1) / 2)
    return np.stack([np.bincount(blocks, x) for x in products], 1)


def _ratio(sums: F64) -> F64:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(sums[..., 0] / sums[..., 1]))


def _correlation(sums: F64) -> F64:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums[..., 2] / np.sqrt(sums[..., 0] * sums[..., 1]))


def _jackknife(moments: F64, statistic: Callable[[F64], F64]) -> Estimate:
    """Statistic of all blocks; its error from leaving out one block at a time."""
    total, n = moments.sum(0), len(moments)
    without = statistic(total - moments)
    error = np.sqrt((n - 1) * np.var(without))
    return Estimate(float(statistic(total)), float(error), n)
