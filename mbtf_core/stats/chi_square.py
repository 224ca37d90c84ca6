"""χ² goodness of fit of a sampler against the density that it claims, in the plane or on the sphere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.stats.estimate import checked

Floats = NDArray[np.float64]

# Gauss-Legendre points per axis of a cell, and how often a cell may be quartered to resolve its density.
_POINTS = 5
_MAX_DEPTH = 8
# Quadrature is refined until its error in the expected count is this share of the count's standard deviation.
_SHARE = 0.02
# Probability that is rounding and not mass.
_ROUNDING = 1e-9


class Domain(Protocol):
    """A two-dimensional domain with parameters whose area element is the domain's own measure."""

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(s0, s1, t0, t1) of the parameter rectangle."""
        ...

    def parameters(self, samples: Floats) -> Floats:
        """Parameters (n, 2) of samples; outside `bounds` for samples outside the domain."""
        ...

    def points(self, parameters: Floats) -> Floats:
        """Points of the domain, as the density takes them, at parameters (n, 2)."""
        ...


@dataclass(frozen=True)
class Rectangle:
    """``[x0, x1] × [y0, y1]``; samples (n, 2), densities per unit area."""

    x0: float = 0.0
    x1: float = 1.0
    y0: float = 0.0
    y1: float = 1.0

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The rectangle itself."""
        return self.x0, self.x1, self.y0, self.y1

    def parameters(self, samples: Floats) -> Floats:
        """The samples themselves."""
        return samples

    def points(self, parameters: Floats) -> Floats:
        """The parameters themselves."""
        return parameters


@dataclass(frozen=True)
class Cap:
    """Directions within a cone around an axis; samples (n, 3) unit vectors, densities per steradian.

    The parameters are ``1 - cos θ`` about the axis and the azimuth. ``1 - cos θ`` comes from the distance to
    the axis, which keeps its precision for lobes of a hundredth of a degree.

    Attributes
    ----------
    axis : center of the cone, need not be of unit length
    cos_min : cosine of the half angle: -1 the sphere (default), 0 a hemisphere
    """

    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    cos_min: float = -1.0
    _frame: Floats = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not -1.0 <= self.cos_min < 1.0:
            raise ValueError(f"cos_min must lie in [-1, 1), not {self.cos_min}")
        n = np.asarray(self.axis, np.float64)
        n = n / np.linalg.norm(n)
        helper = np.eye(3)[int(np.argmin(np.abs(n)))]
        t = np.cross(helper, n)
        t /= np.linalg.norm(t)
        object.__setattr__(self, "_frame", np.stack([t, np.cross(n, t), n]))

    @classmethod
    def of_angle(cls, axis: Sequence[float], degrees: float) -> Cap:
        """Cone of the given half angle in degrees."""
        x, y, z = (float(c) for c in axis)
        return cls((x, y, z), 1.0 - 2.0 * float(np.sin(np.radians(degrees) / 2.0)) ** 2)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """1 - cos θ from 0, azimuth from -π to π."""
        return 0.0, 1.0 - self.cos_min, -np.pi, np.pi

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


@dataclass(frozen=True)
class ChiSquare:
    """Result of a χ² test.

    Attributes
    ----------
    statistic, dof, p_value : p is 0 if a sample lies where the density is zero, or the density exceeds mass 1
    mass : integral of the density over the domain
    observed, expected : counts per cell (rows, columns), before pooling
    outside : (observed, expected) count outside the domain
    note : what the test rests on, in words
    """

    statistic: float
    dof: int
    p_value: float
    mass: float
    observed: Floats
    expected: Floats
    outside: tuple[float, float]
    note: str

    def __str__(self) -> str:
        return (
            f"χ² = {self.statistic:.1f}, {self.dof} degrees of freedom, p = {self.p_value:.3g}; {self.note}"
        )


def chi_square_test(
    samples: ArrayLike,
    pdf: Callable[[Floats], ArrayLike],
    domain: Domain | None = None,
    bins: tuple[int, int] = (16, 32),
    *,
    minimum: float = 5.0,
) -> ChiSquare:
    """Do the samples follow the density?

    Counts samples in equal cells of the domain's parameters and compares with the density's integral over
    each cell, by Gauss-Legendre quadrature refined until its error is a fiftieth of the count's standard
    deviation (so a density may jump within a cell). Cells that expect fewer than `minimum` samples are
    pooled, smallest first. Everything outside the domain is one more cell that expects what the density
    leaves over; a density that is not normalized therefore fails. The statistic ``Σ (O-E)²/E`` follows χ²
    with one degree of freedom less than cells.

    Parameters
    ----------
    samples : (n, 2) points or (n, 3) unit vectors, as the domain takes them; independent draws
    pdf : density at points of that kind, (m, 2 or 3) → (m,), per unit area or steradian
    domain : :class:`Rectangle` (unit square by default) or :class:`Cap`; choose it as large as the density's
        bulk, because a peak much narrower than a cell can slip through the quadrature
    bins : cells along the two parameters

    Raises
    ------
    InputError : samples that are not finite
    ValueError : fewer than two cells are left after pooling, or a negative density
    """
    from scipy.special import chdtrc

    where: Domain = Rectangle() if domain is None else domain
    drawn = checked(samples, "samples")
    n = len(drawn)
    s0, s1, t0, t1 = where.bounds
    s, t = np.linspace(s0, s1, bins[0] + 1), np.linspace(t0, t1, bins[1] + 1)
    q = where.parameters(drawn)
    observed, _, _ = np.histogram2d(q[:, 0], q[:, 1], bins=(s, t))
    corners = np.stack(np.meshgrid(s[:-1], t[:-1], indexing="ij"), axis=-1).reshape(-1, 2)
    size = np.array([(s1 - s0) / bins[0], (t1 - t0) / bins[1]])
    integrals, uncertainty = _integrate(pdf, where, corners, size, n)
    mass = float(integrals.sum())
    left = 1.0 - mass
    resolved = left > uncertainty + _ROUNDING
    # A rest outside that the quadrature cannot tell from none expects no sample, but forbids none either.
    rest = left if resolved else uncertainty if uncertainty > _ROUNDING else 0.0
    outside = (float(n - observed.sum()), n * rest)
    o, e = observed.ravel(), n * integrals
    if resolved or outside[0] > 0:
        o, e = np.append(o, outside[0]), np.append(e, outside[1])
    impossible = int(o[e <= 0.0].sum())
    pooled_o, pooled_e, merged = _pool(o[e > 0.0], e[e > 0.0], minimum)
    if len(pooled_e) < 2:
        raise ValueError("fewer than two cells expect enough samples: draw more or choose a smaller domain")
    statistic = float(((pooled_o - pooled_e) ** 2 / pooled_e).sum())
    dof = len(pooled_e) - 1
    note = f"{n} samples, {len(pooled_e)} cells ({merged} pooled), density integrates to {mass:.6g}"
    if impossible:
        note = f"{note}; {impossible} samples where the density is zero"
    if mass > 1.0 + uncertainty + _ROUNDING:
        note, impossible = f"{note}, which is no density", impossible + 1
    if impossible:
        statistic = float("inf")
    p_value = 0.0 if impossible else float(chdtrc(dof, statistic))
    expected = n * integrals.reshape(bins)
    return ChiSquare(statistic, dof, p_value, mass, observed, expected, outside, note)


def _pool(observed: Floats, expected: Floats, minimum: float) -> tuple[Floats, Floats, int]:
    """Merge cells, smallest expectation first, until each expects `minimum`; and how many were merged."""
    order = np.argsort(expected, kind="stable")
    o, e = observed[order], expected[order]
    total = np.cumsum(e)
    small = int((e < minimum).sum())
    if small == 0:
        return o, e, 0
    # Greedy runs of small cells; the last run takes in the next larger cell if it falls short.
    edges, start = [0], 0.0
    for i in range(small):
        if total[i] - start >= minimum:
            edges.append(i + 1)
            start = total[i]
    if edges[-1] < small:
        edges.append(min(small + 1, len(e)))
    edges += list(range(edges[-1] + 1, len(e) + 1))
    starts = np.asarray(edges[:-1] if edges[-1] == len(e) else edges, np.intp)
    return np.add.reduceat(o, starts), np.add.reduceat(e, starts), small


def _integrate(
    pdf: Callable[[Floats], ArrayLike], domain: Domain, corners: Floats, size: Floats, n: int
) -> tuple[Floats, float]:
    """Integral of the density over each cell (m,) by adaptive quartering, and the error of their sum."""
    abscissae, weights = np.polynomial.legendre.leggauss(_POINTS)
    grid = np.stack(np.meshgrid((abscissae + 1) / 2, (abscissae + 1) / 2, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
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
    extent = size
    for depth in range(_MAX_DEPTH):
        extent = extent / 2.0
        children = (at[:, None, :] + quarters * extent).reshape(-1, 2)
        parts = integral(children, extent)
        fine = parts.reshape(-1, 4).sum(axis=1)
        rough = np.abs(fine - coarse) > tolerance[owner] / 2.0**depth
        if depth == _MAX_DEPTH - 1:
            rough[:] = False
        np.add.at(total, owner[~rough], fine[~rough])
        uncertainty += float(np.abs(fine - coarse)[~rough].sum())
        keep = np.repeat(rough, 4)
        owner, at, coarse = np.repeat(owner, 4)[keep], children[keep], parts[keep]
        if not len(at):
            break
    return total, uncertainty
