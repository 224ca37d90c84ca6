"""Contrast of luminance and chroma beside a reference, and how it depends on the position between texels.

A fit can have a small squared error and still look too smooth, or lose its colors. With the luminance L of a
value and the means over the reference, chroma is what a value has besides its share of the mean color:

    d = (R, G, B) - L · mean(R, G, B) / mean(L).

Contrasts are standard deviations over positions. Those of the reference, and correlations with it, use the
product of its independent halves, so noise biases neither. The contrast of textures also depends on where
queries fall between texels: bilinear texels hold less detail at their corners than at their centers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_core.data.queries import Queries
from mbtf_core.images.read import LUMINANCE
from mbtf_core.stats import Estimate
from mbtf_gen.render.estimates import Stream

if TYPE_CHECKING:
    from mbtf_fit import Material
    from mbtf_gen.render.estimator import Estimator

F64 = NDArray[np.float64]

# Least contrast of chroma over that of luminance for a material that counts as colored.
COLORED = 0.05
# Blocks along each axis of a picture that the jackknife leaves out: neighboring pixels are correlated.
BLOCKS = 8
# Positions in a texel, in texels from its corner along both axes.
PHASES: dict[str, float] = {"centers": 0.5, "quarters": 0.25, "corners": 0.0}
# Queries of each phase, paths of each, and levels below the finest.
_PHASE_QUERIES, _PHASE_PATHS, _PHASE_LEVELS = 1024, 256, (0, 2)
# Random numbers beyond those of pictures.
_FIRST_STREAM = 1 << 27

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


def phase_queries(
    lattice: Lattice,
    level: int,
    phase: float,
    omega_i: Sequence[float] | F64,
    omega_o: Sequence[float] | F64,
    most: int,
    seed: int = 0,
) -> Queries:
    """Queries at one place in each of at most so many texels of a level, with the footprint of the level.

    Parameters
    ----------
    phase : place in the texel along both axes, in texels from its corner; see :data:`PHASES`
    omega_i, omega_o : unit vectors towards light and viewer
    most : largest number of queries; texels are then chosen at random, without repetition
    """
    rows, columns = lattice.shape(level)
    chosen = np.random.default_rng(seed).permutation(rows * columns)[:most]
    u = np.stack([(chosen % columns + phase) / columns, (chosen // columns + phase) / rows], 1)
    n = len(chosen)
    directions = [np.tile(np.asarray(w, np.float32), (n, 1)) for w in (omega_i, omega_o)]
    sigma = np.full(n, sigma_of_level(level), np.float32)
    return Queries(u.astype(np.float32), sigma, *directions)


def phase_contrasts(
    estimator: Estimator,
    materials: Mapping[str, Material],
    lattice: Lattice,
    omega_i: F64,
    omega_o: F64,
    seed: int,
) -> list[dict[str, Any]]:
    """Contrast of luminance of fits at places between texels, relative to path-traced values there.

    Parameters
    ----------
    materials : fitted materials by name
    omega_i, omega_o : unit vectors towards light and viewer

    Returns
    -------
    list of dict
        One of each level and phase: ``level``, ``phase``, and ``fits`` with an estimate by name.
    """
    out = []
    for level in sorted({max(0, lattice.finest - below) for below in _PHASE_LEVELS}):
        for number, (phase, place) in enumerate(PHASES.items()):
            queries = phase_queries(lattice, level, place, omega_i, omega_o, _PHASE_QUERIES)
            stream = Stream(seed, "reference", _FIRST_STREAM + len(PHASES) * level + number)
            found = estimator.estimate(queries, _PHASE_PATHS, stream)
            arrays = queries.u, queries.sigma, queries.omega_i, queries.omega_o
            # Texels are in random order, so every 32nd one is a random subset.
            blocks = np.arange(len(queries.sigma)) % 32
            fits = {}
            for name, material in materials.items():
                one = contrast(material.evaluate(*arrays), found.value_a, found.value_b, blocks)["luminance"]
                fits[name] = None if one is None else one.as_dict()
            out.append({"level": level, "phase": phase, "fits": fits})
    return out


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
