"""The smoothed directional light in kernels, one light per lane.

The radiance is ``L(ω) = p(ω) [ω_z > 0] / E``: a von Mises–Fisher lobe p around ω_i (Fisher 1953, "Dispersion
on a Sphere"), normalized to irradiance 1 on the reference plane by
:meth:`mbtf_gen.sampling.light_kernel.LightKernel.irradiance`. Directions are sampled from the lobe (Jakob
2012, "Numerically stable sampling of the von Mises Fisher distribution on S²") and mirrored at the horizon
where they fall below it. Their density is ``q(ω) = p(ω) + p(ω mirrored)``, which is positive where L is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mbtf_gen.render.types import Float, Point2f, UInt32, Vector3f
from mbtf_gen.sampling.light_kernel import LightKernel


@dataclass(frozen=True)
class DirectionalLight:
    """Light of each lane.

    Attributes
    ----------
    kind : {"lobe", "delta", "constant"}
        ``constant`` is radiance 1 from the whole upper hemisphere.
    omega_i : Vector3f
        Direction towards the light.
    inverse_irradiance : Float
        1/E(ω_i), with E the irradiance of the lobe on the reference plane.
    kappa : Float
        Concentration of the lobe.
    """

    kind: Literal["lobe", "delta", "constant"]
    omega_i: Vector3f = None
    inverse_irradiance: Float = None
    kappa: Float = None

    @classmethod
    def of(cls, kernel: LightKernel | None, omega_i: ArrayLike) -> DirectionalLight:
        """Lights from directions (n, 3); constant radiance without a kernel."""
        if kernel is None:
            return cls("constant")
        w = np.asarray(omega_i, np.float32)
        towards = mi.Vector3f(w.T.copy())
        inverse = mi.Float((1.0 / kernel.irradiance(w)).astype(np.float32))
        # Evaluated before any kernel reads them: otherwise their number would be part of the kernel.
        dr.eval(towards, inverse)
        kappa = dr.opaque(mi.Float, 0.0 if kernel.is_delta else kernel.kappa)
        return cls("delta" if kernel.is_delta else "lobe", towards, inverse, kappa)

    def at(self, index: UInt32) -> DirectionalLight:
        """Lights of a batch gathered by their number."""
        if self.kind == "constant":
            return self
        omega_i = dr.gather(mi.Vector3f, self.omega_i, index)
        return replace(
            self, omega_i=omega_i, inverse_irradiance=dr.gather(mi.Float, self.inverse_irradiance, index)
        )

    def density(self, omega: Vector3f, mean: Vector3f) -> Float:
        """Density of the lobe around `mean` in 1/sr; |ω - mean|²/2 is 1 - ω·mean without cancellation."""
        norm = self.kappa / (dr.two_pi * (1.0 - dr.exp(-2.0 * self.kappa)))
        return norm * dr.exp(-0.5 * self.kappa * dr.squared_norm(omega - mean))

    def radiance(self, omega: Vector3f) -> Float:
        """Radiance arriving from ω above the horizon; 0 for a delta light."""
        if self.kind == "constant":
            return mi.Float(1.0)
        if self.kind == "delta":
            return mi.Float(0.0)
        return self.density(omega, self.omega_i) * self.inverse_irradiance

    def sampling_density(self, omega: Vector3f) -> Float:
        """Density in 1/sr of :meth:`sample`."""
        if self.kind != "lobe":
            return mi.Float(0.0)
        w = self.omega_i
        return self.density(omega, w) + self.density(omega, mi.Vector3f(w.x, w.y, -w.z))

    def sample(self, xi: Point2f) -> Vector3f:
        """Sample a direction above the horizon: from the lobe, mirrored where it falls below."""
        versine = -dr.log(1.0 - xi.x * (1.0 - dr.exp(-2.0 * self.kappa))) / self.kappa
        sine = dr.safe_sqrt(versine * (2.0 - versine))
        s, c = dr.sincos(dr.two_pi * xi.y)
        omega = mi.Frame3f(self.omega_i).to_world(mi.Vector3f(sine * c, sine * s, 1.0 - versine))
        return mi.Vector3f(omega.x, omega.y, dr.abs(omega.z))
