"""χ² goodness of fit of a sampler against the density that it claims, in the plane or on the sphere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc

from mbtf_core.stats.estimate import checked

Floats = NDArray[np.float64]

# Gauss-Legendre points per axis of a cell, and how often a cell may be quartered to resolve its density.
_POINTS = 5
_MAX_DEPTH = 8
# Quadrature is refined until its error in the expected count is this share of the count's standard deviation.
_SHARE = 0.02
# Probability that is rounding and not mass.
_ROUNDING = 1e-9
# Cells that expect fewer samples are pooled.
_FEWEST = 5.0


@dataclass(frozen=True)
class Rectangle:
    """``[x0, x1] × [y0, y1]``; samples (n, 2), densities per unit area."""

    x0: float = 0.0
    x1: float = 1.0
    y0: float = 0.0
    y1: float = 1.0

    @property
    def bounds(self) -> tuple[float, ...]:
        """(s0, s1, t0, t1) of the parameters, whose area element is the domain's own measure."""
        return astuple(self)

    def parameters(self, samples: Floats) -> Floats:
        """Parameters (n, 2) of samples; outside `bounds` for samples outside the domain."""
        return samples

    def points(self, parameters: Floats) -> Floats:
        """Points of the domain, as the density takes them, at parameters (n, 2)."""
        return parameters


class Cap:
    """Directions within a cone around an axis; samples (n, 3) unit vectors, densities per steradian.

    The parameters are ``1 - cos θ`` about the axis and the azimuth. ``1 - cos θ`` comes from the distance to
    the axis, which keeps its precision for lobes of a hundredth of a degree. The cosine of the half angle is
    -1 for the sphere, 0 for a hemisphere.
    """

    def __init__(self, axis: Sequence[float] = (0.0, 0.0, 1.0), cos_min: float = -1.0) -> None:
        n = np.asarray(axis, np.float64) / np.linalg.norm(axis)
        t = np.cross(np.eye(3)[int(np.argmin(np.abs(n)))], n)
        t /= np.linalg.norm(t)
        self._frame = np.stack([t, np.cross(n, t), n])
        self.bounds = (0.0, 1.0 - cos_min, -np.pi, np.pi)

    @classmethod
    def of_angle(cls, axis: Sequence[float], degrees: float) -> Cap:
        """Cone of the given half angle in degrees."""
        return cls(axis, 1.0 - 2.0 * float(np.sin(np.radians(degrees) / 2.0)) ** 2)

    def parameters(self, samples: Floats) -> Floats:
        """(1 - cos θ, azimuth) of directions (n, 3)."""
        local = samples @ self._frame.T
        height = ((samples - self._frame[2]) ** 2).sum(axis=-1) / 2.0
        return np.stack([height, np.arctan2(local[:, 1], local[:, 0])], axis=-1)

    def points(self, parameters: Floats) -> Floats:
        """Directions (n, 3) at (1 - cos θ, azimuth)."""
        h, phi = parameters[:, 0], parameters[:, 1]
        r = np.sqrt(np.maximum(0.0, h * (2.0 - h)))
        return np.stack([r * np.cos(phi), r * np.sin(phi), 1.0 - h], axis=-1) @ self._frame


class ChiSquare(NamedTuple):
    """Result of a χ² test, and what it rests on in words."""

    p_value: float
    note: str


def chi_square_test(
    samples: ArrayLike,
    pdf: Callable[[Floats], ArrayLike],
    domain: Rectangle | Cap,
    bins: tuple[int, int] = (16, 32),
) -> ChiSquare:
    """Do the samples follow the density, (m, 2 or 3) → (m,) per unit area or steradian?

    Counts samples in equal cells of the domain's parameters and compares with the density's integral over
    each cell (which may jump within the cell). Cells that expect few samples are pooled. Everything outside
    the domain is one more cell that expects what the density leaves over; a
    density that is not normalized therefore fails. The statistic ``Σ (O-E)²/E`` follows χ² with one degree of
    freedom less than cells. Choose the domain as large as the density's bulk, because a peak much narrower
    than a cell can slip through the quadrature.
    """
    drawn = checked(samples, "samples")
    n = len(drawn)
    s0, s1, t0, t1 = domain.bounds
    s, t = np.linspace(s0, s1, bins[0] + 1), np.linspace(t0, t1, bins[1] + 1)
    u, v = domain.parameters(drawn).T
    observed, _, _ = np.histogram2d(u, v, bins=[s, t])
    corners = np.stack(np.meshgrid(s[:-1], t[:-1], indexing="ij"), axis=-1).reshape(-1, 2)
    integrals, uncertainty = _integrate(pdf, domain, corners, np.array([s[1] - s0, t[1] - t0]), n)
    left, outside = 1.0 - float(integrals.sum()), n - observed.sum()
    o, e = observed.ravel(), n * integrals
    if left > uncertainty + _ROUNDING:
        o, e = np.append(o, outside), np.append(e, n * left)
    elif outside:
        # A rest that the quadrature cannot tell from none forbids no sample.
        o, e = np.append(o, outside), np.append(e, n * uncertainty if uncertainty > _ROUNDING else 0.0)
    note = f"{n} samples, density integrates to {1.0 - left:.6g}"
    if impossible := int(o[e <= 0.0].sum()):
        return ChiSquare(0.0, f"{note}; {impossible} samples where the density is zero")
    if left < -uncertainty - _ROUNDING:
        return ChiSquare(0.0, f"{note}, which is no density")
    order = np.argsort(e, kind="stable")
    o, e = o[order], e[order]
    # The smallest cells, as many as expect too little each or together, become one.
    pooled = max(np.searchsorted(e, _FEWEST), np.searchsorted(np.cumsum(e), _FEWEST) + 1)
    o, e = np.append(o[pooled:], o[:pooled].sum()), np.append(e[pooled:], e[:pooled].sum())
    if len(e) < 2:
        raise ValueError("fewer than two cells expect enough samples: draw more or choose a smaller domain")
    return ChiSquare(float(chdtrc(len(e) - 1, ((o - e) ** 2 / e).sum())), f"{note}; {len(e)} cells")


def uniformity(x: ArrayLike, y: ArrayLike, bins: tuple[int, int] = (16, 16)) -> float:
    """p-value of the hypothesis that numbers in [0, 1) are uniform, and independent pair by pair."""
    return chi_square_test(np.column_stack([x, y]), lambda q: np.ones(len(q)), Rectangle(), bins).p_value


def _integrate(
    pdf: Callable[[Floats], ArrayLike], domain: Rectangle | Cap, corners: Floats, size: Floats, n: int
) -> tuple[Floats, float]:
    """Integral of the density over each cell (m,) by adaptive quartering, and the error of their sum."""
    abscissae, weights = np.polynomial.legendre.leggauss(_POINTS)
    grid = np.stack(np.meshgrid(abscissae, abscissae, indexing="ij"), axis=-1).reshape(-1, 2) / 2.0 + 0.5
    weight = np.outer(weights, weights).ravel() / 4.0

    def integral(at: Floats, extent: Floats) -> Floats:
        points = domain.points((at[:, None, :] + grid * extent).reshape(-1, 2))
        density = np.asarray(pdf(points), np.float64).reshape(len(at), -1)
        if not np.all(density >= 0.0):
            raise ValueError("the density is negative or NaN somewhere in the domain")
        return density @ weight * extent[0] * extent[1]

    quarters = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.float64)
    total, uncertainty = np.zeros(len(corners)), 0.0
    owner, at, coarse = np.arange(len(corners)), corners, integral(corners, size)
    tolerance = _SHARE * np.sqrt(np.maximum(coarse * n, 1.0)) / n
    for depth in range(_MAX_DEPTH):
        size = size / 2.0
        children = (at[:, None, :] + quarters * size).reshape(-1, 2)
        parts = integral(children, size)
        fine = parts.reshape(-1, 4).sum(axis=1)
        rough = (np.abs(fine - coarse) > tolerance[owner] / 2.0**depth) & (depth < _MAX_DEPTH - 1)
        np.add.at(total, owner[~rough], fine[~rough])
        uncertainty += float(np.abs(fine - coarse)[~rough].sum())
        keep = np.repeat(rough, 4)
        owner, at, coarse = np.repeat(owner, 4)[keep], children[keep], parts[keep]
        if not len(at):
            break
    return total, uncertainty
