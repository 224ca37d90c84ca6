"""The smoothed directional light in kernels, one light per lane.

The radiance is ``L(ω) = p(ω) [ω_z > 0] / E``: a von Mises–Fisher lobe p around ω_i (Fisher 1953, "Dispersion
on a Sphere"), normalized to irradiance 1 on the reference plane by
:meth:`mbtf_gen.sampling.light_kernel.LightKernel.irradiance`. Directions are sampled from the lobe (Jakob
2012, "Numerically stable sampling of the von Mises Fisher distribution on S²") and mirrored at the horizon
where they fall below it. Their density is ``q(ω) = p(ω) + p(ω mirrored)``, which is positive where L is.

The generator's own loop calls :class:`DirectionalLight`; :class:`SmoothedDirectional` is the same light as an
emitter, for Mitsuba's integrators.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mbtf_gen.engine.types import (
    DirectionSample3f,
    Float,
    Mask,
    Point2f,
    Properties,
    Spectrum,
    SurfaceInteraction3f,
    UInt32,
    Vector3f,
    padded,
)
from mbtf_gen.sampling.light_kernel import LightKernel

# Length of shadow rays in Mitsuba's integrators, in scene units. Mitsuba does not pass the scene's size to
# emitters in Python, so it is a constant: thousands of tiles, with directions exact to 1e-7.
SHADOW_DISTANCE = 1.0e5


@dataclass(frozen=True)
class DirectionalLight:
    """Light of each lane.

    Attributes
    ----------
    kind : {"lobe", "delta", "constant"}, ``constant`` is radiance 1 from above, and from below where rays can
        pass through the tile
    omega_i : direction towards the light
    inverse_irradiance : Float
        1/E(ω_i), with E the irradiance of the lobe on the reference plane.
    kappa : concentration of the lobe
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
        towards = mi.Vector3f(padded(w.T))
        inverse = mi.Float(padded((1.0 / kernel.irradiance(w)).astype(np.float32)))
        # Evaluated before any kernel reads them: otherwise their number would be part of the kernel.
        dr.eval(towards, inverse)
        kappa = dr.opaque(mi.Float, 0.0 if kernel.is_delta else kernel.kappa)
        return cls("delta" if kernel.is_delta else "lobe", towards, inverse, kappa)

    def at(self, index: UInt32) -> DirectionalLight:
        """Lights of a batch gathered by their number."""
        if self.kind == "constant":
            return self
        omega_i = dr.gather(mi.Vector3f, self.omega_i, index)
        inverse = dr.gather(mi.Float, self.inverse_irradiance, index)
        return DirectionalLight(self.kind, omega_i, inverse, self.kappa)

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


class SmoothedDirectional(mi.Emitter):
    """``mbtf_directional``: a von Mises–Fisher lobe cut at the horizon, with irradiance 1 on the plane z = 0.

    Plugin parameters: ``width`` (RMS angle per axis in degrees, 0 for a delta light), ``direction`` (towards
    the light). In place of it, :meth:`set_directions` sets the lights of a batch of queries; a ray's query is
    the number that :class:`~mbtf_gen.render.scene.QuerySensor` stores in its time.
    """

    def __init__(self, props: Properties) -> None:
        super().__init__(props)
        self.kernel = LightKernel(float(props.get("width", 1.0)))
        flags = mi.EmitterFlags.Infinite
        self.m_flags = flags | mi.EmitterFlags.DeltaDirection if self.kernel.is_delta else flags
        direction = props.get("direction", mi.ScalarVector3f(0, 0, 1))
        self.set_directions(np.asarray(direction, np.float32).reshape(1, 3))

    def set_directions(self, omega_i: ArrayLike) -> None:
        """Set the light directions (n, 3) of a batch of queries; a single row is used for all rays."""
        self.lights = DirectionalLight.of(self.kernel, omega_i)

    def _light(self, time: Float) -> DirectionalLight:
        return self.lights.at(dr.minimum(mi.UInt32(time), dr.width(self.lights.omega_i) - 1))

    def eval(self, si: SurfaceInteraction3f, active: Mask = True) -> Spectrum:
        """Radiance arriving against ``si.wi`` from above the horizon."""
        omega = -si.wi
        return dr.select(active & (omega.z > 0), mi.Spectrum(self._light(si.time).radiance(omega)), 0.0)

    def sample_direction(
        self, it: SurfaceInteraction3f, sample: Point2f, active: Mask = True
    ) -> tuple[DirectionSample3f, Spectrum]:
        """Sample a direction towards the light; returns it with radiance over density."""
        light = self._light(it.time)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(it))
        if self.kernel.is_delta:
            omega, pdf, weight = light.omega_i, mi.Float(1.0), light.inverse_irradiance
        else:
            omega = light.sample(sample)
            pdf = light.sampling_density(omega)
            weight = light.radiance(omega) / pdf
        ds.d = omega
        ds.dist = mi.Float(SHADOW_DISTANCE)
        ds.p = dr.fma(omega, ds.dist, it.p)
        ds.n = -omega
        ds.time = it.time
        ds.pdf = pdf
        ds.delta = mi.Bool(self.kernel.is_delta)
        ds.emitter = mi.EmitterPtr(self)
        return ds, dr.select(active, mi.Spectrum(weight), 0.0)

    def pdf_direction(self, it: SurfaceInteraction3f, ds: DirectionSample3f, active: Mask = True) -> Float:
        """Density of :meth:`sample_direction` at ``ds.d`` in 1/sr; 0 for a delta light."""
        return dr.select(active & (ds.d.z > 0), self._light(it.time).sampling_density(ds.d), 0.0)

    def eval_direction(
        self, it: SurfaceInteraction3f, ds: DirectionSample3f, active: Mask = True
    ) -> Spectrum:
        """Radiance arriving from ``ds.d``."""
        return dr.select(active & (ds.d.z > 0), mi.Spectrum(self._light(it.time).radiance(ds.d)), 0.0)

    def is_environment(self) -> bool:
        """Rays that leave the scene see the light."""
        return True

    def bbox(self) -> Any:
        """Empty: the light is at infinity."""
        return mi.ScalarBoundingBox3f()
