"""The smoothed directional light as a Mitsuba emitter, for Mitsuba's integrators.

It has either one direction (parameter ``direction``, towards the light) or the ``omega_i`` of a batch of
queries. It finds the query by the number that :class:`~mbtf_gen.render.sensor.QuerySensor` stores in the
ray's time. The formulas are those of :class:`~mbtf_gen.render.directional_light.DirectionalLight`, which the
generator's own loop uses.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.types import (
    DirectionSample3f,
    Float,
    Mask,
    Point2f,
    Properties,
    Spectrum,
    SurfaceInteraction3f,
)
from mbtf_gen.sampling.light_kernel import LightKernel

# Length of shadow rays in Mitsuba's integrators, in scene units. Mitsuba does not pass the scene's size to
# emitters in Python, so it is a constant: thousands of tiles, with directions exact to 1e-7.
SHADOW_DISTANCE = 1.0e5


class SmoothedDirectional(mi.Emitter):
    """``mbtf_directional``: a von Mises–Fisher lobe cut at the horizon, with irradiance 1 on the plane z = 0.

    Plugin parameters: ``width`` (RMS angle per axis in degrees, 0 for a delta light), ``direction`` (towards
    the light).
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
        if self.kernel.is_delta:
            return mi.Float(0.0)
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

    def to_string(self) -> str:
        """Description that Mitsuba prints."""
        return f"SmoothedDirectional[width = {self.kernel.width_deg} degrees]"
