"""The smoothed directional light inside kernels, another one for every lane.

Light directions are drawn from the lobe and, where they fall below the horizon, reflected up at it: their
density ``q(ω) = p(ω) + p(ω mirrored)`` is exact, positive where ``L`` is, and no sample is lost below the
horizon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class DirectionalLight:
    """Light of every lane.

    Attributes
    ----------
    kind : ``lobe``, ``delta``, or ``constant`` (radiance 1 from everywhere above the horizon)
    omega_i : direction towards the light, one per lane
    inverse_irradiance : 1/E(ω_i), one per lane
    kappa : concentration of the lobe
    """

    kind: Literal["lobe", "delta", "constant"]
    omega_i: Any = None
    inverse_irradiance: Any = None
    kappa: Any = None

    def density(self, omega: Any, about: Any) -> Any:
        """Lobe density in 1/sr, from |ω - ω_i|²/2."""
        norm = self.kappa / (dr.two_pi * (1.0 - dr.exp(-2.0 * self.kappa)))
        return norm * dr.exp(-0.5 * self.kappa * dr.squared_norm(omega - about))

    def mirrored(self) -> Any:
        """ω_i reflected at the horizon."""
        return mi.Vector3f(self.omega_i.x, self.omega_i.y, -self.omega_i.z)

    def radiance(self, omega: Any) -> Any:
        """Radiance that arrives from ω above the horizon; 0 for a delta light."""
        if self.kind == "constant":
            return mi.Float(1.0)
        if self.kind == "delta":
            return mi.Float(0.0)
        return self.density(omega, self.omega_i) * self.inverse_irradiance

    def sampling_density(self, omega: Any) -> Any:
        """Density in 1/sr of :meth:`sample`."""
        if self.kind != "lobe":
            return mi.Float(0.0)
        return self.density(omega, self.omega_i) + self.density(omega, self.mirrored())

    def sample(self, xi: Any) -> Any:
        """A direction above the horizon: from the lobe, reflected up where it falls below."""
        versine = -dr.log(1.0 - xi.x * (1.0 - dr.exp(-2.0 * self.kappa))) / self.kappa
        sine = dr.safe_sqrt(versine * (2.0 - versine))
        s, c = dr.sincos(dr.two_pi * xi.y)
        omega = mi.Frame3f(self.omega_i).to_world(mi.Vector3f(sine * c, sine * s, 1.0 - versine))
        return mi.Vector3f(omega.x, omega.y, dr.abs(omega.z))
