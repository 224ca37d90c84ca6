r"""The light kernel: a von Mises–Fisher lobe around ω_i, cut at the horizon, of unit irradiance.

    p(ω) = κ / (2π (1 - e^{-2κ})) · exp(-κ (1 - ω·ω_i))
    L(ω) = p(ω) [ω_z > 0] / E(ω_i),    E(ω_i) = ∫ p(ω) max(ω_z, 0) dω

so that the irradiance on the reference plane is 1 at every elevation. The width of the lobe is its RMS angle
per axis in degrees, ``δ² = E[θ²]/2`` with θ the angle to the axis; κ ≈ 1/δ² for narrow lobes. Width 0 is a
delta light, ``E = ω_i,z``.

``1 - ω·ω_i`` is always computed as ``|ω - ω_i|²/2``: in single precision the cosine of a 0.05° lobe has only
a few hundred distinct values left.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

# The uniform sphere has an RMS angle of 69° per axis; beyond this a lobe is no longer a light from one side.
MAX_WIDTH_DEG = 45.0
# In single precision, narrower lobes are indistinguishable from a delta light.
MIN_WIDTH_DEG = 0.01
# Elevation, in widths of the lobe, above which the horizon removes a negligible part of it.
NEAR_WIDTHS = 10.0

# Cached, because nodes of high order take a tenth of a second.
_gauss = cache(np.polynomial.legendre.leggauss)


def _density(kappa: float, versine: ArrayLike) -> NDArray[np.float64]:
    """Lobe density in 1/sr as a function of 1 - cos θ."""
    norm = kappa / (2.0 * np.pi * -np.expm1(-2.0 * kappa))
    return norm * np.exp(-kappa * np.asarray(versine, np.float64))


def rms_angle_deg(kappa: float) -> float:
    """RMS angle per axis, in degrees, of a von Mises–Fisher lobe of concentration κ."""
    # Up to e^-40 of the lobe's peak.
    end = float(np.arccos(max(-1.0, 1.0 - 40.0 / kappa)))
    x, w = _gauss(400)
    theta, weight = 0.5 * end * (x + 1.0), 0.5 * end * w
    density = _density(kappa, 2.0 * np.sin(0.5 * theta) ** 2) * 2.0 * np.pi * np.sin(theta)
    return float(np.degrees(np.sqrt(0.5 * np.sum(weight * density * theta**2) / np.sum(weight * density))))


def concentration(width_deg: float) -> float:
    """Concentration κ of the lobe whose RMS angle per axis is `width_deg` degrees."""
    from scipy.optimize import brentq

    start = 1.0 / np.radians(width_deg) ** 2
    low, high = np.log(start) - 1.0, np.log(start) + 1.0
    return float(np.exp(brentq(lambda x: rms_angle_deg(float(np.exp(x))) - width_deg, low, high, xtol=1e-13)))


def _mean_positive_part(mean: NDArray[np.float64], amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over φ of ``max(0, mean + amplitude·cos φ)`` for amplitude ≥ 0."""
    ratio = np.clip(-mean / np.maximum(amplitude, 1e-300), -1.0, 1.0)
    edge = np.arccos(ratio)
    partial = (mean * edge + amplitude * np.sin(edge)) / np.pi
    return np.where(mean >= amplitude, mean, np.where(mean <= -amplitude, 0.0, partial))


def lobe_irradiance(kappa: float, elevation: ArrayLike) -> NDArray[np.float64]:
    """E = ∫ p(ω) max(ω_z, 0) dω by quadrature, for elevations of ω_i in radians (any shape)."""
    alpha = np.atleast_1d(np.asarray(elevation, np.float64))
    end = float(np.arccos(max(-1.0, 1.0 - 40.0 / kappa)))
    x, w = _gauss(128)
    total = np.zeros_like(alpha)
    # The inner mean has a kink where the cone of half-angle θ touches the horizon, at θ = elevation.
    kink = np.clip(alpha, 0.0, end)
    for low, high in ((np.zeros_like(kink), kink), (kink, np.full_like(kink, end))):
        half = 0.5 * (high - low)
        # Squaring the abscissa towards the kink removes the root singularity that the mean has there.
        s = 0.5 * (x + 1.0)
        offset = 2.0 * half[..., None] * s**2
        t = low[..., None] + offset if low is kink else high[..., None] - offset
        jacobian = 4.0 * half[..., None] * s * 0.5
        density = _density(kappa, 2.0 * np.sin(0.5 * t) ** 2) * 2.0 * np.pi * np.sin(t)
        inner = _mean_positive_part(
            np.cos(t) * np.sin(alpha[..., None]), np.sin(t) * np.cos(alpha[..., None])
        )
        total += np.sum(w * jacobian * density * inner, axis=-1)
    return total.reshape(np.shape(elevation))


@cache
def _lobe(width_deg: float) -> tuple[float, Any]:
    """Concentration of a lobe, and its irradiance as a spline over low elevations; a fifth of a second."""
    from scipy.interpolate import CubicSpline

    kappa = concentration(width_deg)
    # Dense, for E departs from sin(elevation) here.
    elevation = np.linspace(0.0, min(NEAR_WIDTHS * np.radians(width_deg), np.pi / 2), 2049)
    return kappa, CubicSpline(elevation, lobe_irradiance(kappa, elevation))


@dataclass(frozen=True)
class LightKernel:
    """Smoothed directional light of a given width.

    Attributes
    ----------
    width_deg : float
        RMS angle per axis in degrees, 0 or in [0.01, 45]; 0 is a delta light.

    Raises
    ------
    ValueError
        The width is out of range.
    """

    width_deg: float

    def __post_init__(self) -> None:
        if self.width_deg != 0 and not MIN_WIDTH_DEG <= self.width_deg <= MAX_WIDTH_DEG:
            raise ValueError(
                f"light width must be 0 or {MIN_WIDTH_DEG}..{MAX_WIDTH_DEG} degrees, not {self.width_deg}"
            )

    @property
    def is_delta(self) -> bool:
        """True for width 0."""
        return self.width_deg == 0

    @property
    def kappa(self) -> float:
        """Concentration κ of the lobe; infinite for a delta light."""
        return np.inf if self.is_delta else _lobe(float(self.width_deg))[0]

    def irradiance(self, omega_i: ArrayLike) -> NDArray[np.float64]:
        """Irradiance E of the lobe on the reference plane, the divisor of the radiance.

        Parameters
        ----------
        omega_i : (..., 3) array
            Unit vectors towards the light, z ≥ 0.

        Returns
        -------
        (...) float64 array
        """
        w = np.asarray(omega_i, np.float64)
        if self.is_delta:
            return w[..., 2].copy()
        # Away from the horizon: the mean cosine of the whole lobe.
        out = np.array(w[..., 2] * (1.0 / np.tanh(self.kappa) - 1.0 / self.kappa))
        widest = NEAR_WIDTHS * np.radians(self.width_deg)
        near = w[..., 2] < (np.sin(widest) if widest < np.pi / 2 else np.inf)
        low = w[near]
        out[near] = _lobe(float(self.width_deg))[1](
            np.arctan2(low[..., 2], np.hypot(low[..., 0], low[..., 1]))
        )
        return out

    def sample(self, omega_i: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Sample one direction from the lobe around each axis, not cut at the horizon.

        Parameters
        ----------
        omega_i : (n, 3) float64 array
            Unit vectors towards the light.
        rng : numpy.random.Generator

        Returns
        -------
        (n, 3) float64 array
        """
        if self.is_delta:
            return omega_i
        xi, turn = rng.random(len(omega_i)), 2.0 * np.pi * rng.random(len(omega_i))
        versine = -np.log1p(xi * np.expm1(-2.0 * self.kappa)) / self.kappa
        sine = np.sqrt(np.maximum(versine * (2.0 - versine), 0.0))
        across = np.where(np.abs(omega_i[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        first = np.cross(omega_i, across)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(omega_i, first)
        aside = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
        return np.asarray((1.0 - versine)[:, None] * omega_i + sine[:, None] * aside)

    def radiance(self, omega: ArrayLike, omega_i: ArrayLike) -> NDArray[np.float64]:
        """Incident radiance L(ω): the lobe, cut at the horizon and normalized to unit irradiance;
        undefined for a delta light.

        Parameters
        ----------
        omega, omega_i : (..., 3) arrays
            Unit vectors: the direction, and the axis of the lobe.

        Returns
        -------
        (...) float64 array
            Radiance in 1/sr.
        """
        difference = np.asarray(omega, np.float64) - np.asarray(omega_i, np.float64)
        density = _density(self.kappa, 0.5 * np.sum(difference**2, axis=-1))
        return np.where(np.asarray(omega)[..., 2] > 0, density, 0.0) / self.irradiance(omega_i)
