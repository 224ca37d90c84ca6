"""The path tracer: radiance leaving the displaced tile along given rays, one light per ray.

Next-event estimation on the light and BSDF sampling, combined by the balance heuristic (Veach 1997); Russian
roulette ends paths without bias. Light directions are drawn from the lobe and, where they fall below the
horizon, reflected up at it: their density ``q(ω) = p(ω) + p(ω mirrored)`` is exact, positive where ``L`` is,
and no sample is lost below the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from .periodic import Period, closest_hit, leave, occluded

# Roulette leaves paths of throughput one alone, for dividing by a survival chance below it makes their
# weights grow without bound in white cracks; only after this many interactions they end with a chance of one
# in two hundred each.
PATIENCE = 64
LATE_SURVIVAL = 0.995


@dataclass(frozen=True)
class Transport:
    """How paths are followed.

    Attributes
    ----------
    max_depth : largest number of surface interactions of a path; 0 means no limit
    roulette_depth : interactions before Russian roulette begins
    max_crossings : tile borders that one ray may cross
    """

    max_depth: int = 0
    roulette_depth: int = 3
    max_crossings: int = 4096


@dataclass(frozen=True)
class LaneLight:
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


def _next_2d(rng: Any) -> Any:
    return mi.Point2f(rng.next_float32(), rng.next_float32())


@dr.syntax
def trace(
    scene: Any, period: Period, ray: Any, light: LaneLight, transport: Transport, rng: Any, active: Any
) -> tuple[Any, Any, Any]:
    """Radiance towards the rays' origins.

    Returns
    -------
    (radiance; rays that went down and met nothing; rays cut off at the cap on crossings)
    """
    ray = mi.Ray3f(ray)
    radiance = mi.Spectrum(0.0)
    throughput = mi.Spectrum(1.0)
    depth = mi.UInt32(0)
    capped = mi.UInt32(0)
    lost = mi.Bool(False)
    active = mi.Bool(active)
    # Density with which the last bounce chose its direction; infinite makes the balance heuristic give it
    # all.
    bounce_pdf = mi.Float(dr.inf)
    context = mi.BSDFContext()
    while dr.hint(active, exclude=[scene, period, light, transport, context]):
        si, _, cap = closest_hit(scene, period, ray, active, transport.max_crossings)
        capped[cap] += 1
        escaped = active & ~si.is_valid() & ~cap
        lost |= escaped & (ray.d.z <= 0)
        sky = light.radiance(ray.d)
        share = dr.select(
            dr.isinf(bounce_pdf), 1.0, bounce_pdf / (bounce_pdf + light.sampling_density(ray.d))
        )
        radiance[escaped & (depth > 0) & (ray.d.z > 0)] += throughput * sky * share

        active &= si.is_valid()
        if dr.hint(transport.max_depth > 0, mode="scalar"):
            active &= depth < transport.max_depth

        bsdf = si.bsdf()
        if dr.hint(light.kind == "lobe", mode="scalar"):
            omega = light.sample(_next_2d(rng))
            light_pdf = light.sampling_density(omega)
            incoming = light.radiance(omega)
        elif dr.hint(light.kind == "delta", mode="scalar"):
            omega = light.omega_i
            light_pdf = mi.Float(1.0)
            incoming = light.inverse_irradiance
        if dr.hint(light.kind != "constant", mode="scalar"):
            wo = si.to_local(omega)
            value, pdf, bs, weight = bsdf.eval_pdf_sample(
                context, si, wo, rng.next_float32(), _next_2d(rng), active
            )
            # Written so that NaN counts as light: it must reach the value, where it is found and drawn again.
            connect = active & ~(dr.max(value) <= 0)
            blocked, _, cap = occluded(
                scene, period, leave(period, si, omega), connect, transport.max_crossings
            )
            capped[cap] += 1
            if dr.hint(light.kind == "delta", mode="scalar"):
                share = mi.Float(1.0)
            else:
                share = 1.0 / (light_pdf + pdf)
            radiance[connect & ~blocked] += throughput * value * (incoming * share)
        else:
            bs, weight = bsdf.sample(context, si, rng.next_float32(), _next_2d(rng), active)

        throughput *= weight
        bounce_pdf = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), dr.inf, bs.pdf)
        ray = leave(period, si, si.to_world(bs.wo))
        depth[active] += 1
        strongest = dr.max(throughput)
        # A path of NaN throughput would end here as if it were black.
        radiance[active & dr.isnan(strongest)] = mi.Spectrum(dr.nan)
        active &= strongest > 0
        longest = dr.select(depth < PATIENCE, 1.0, LATE_SURVIVAL)
        survival = dr.select(depth >= transport.roulette_depth, dr.minimum(strongest, longest), 1.0)
        active &= rng.next_float32() < survival
        throughput *= dr.rcp(survival)
    return radiance, lost, capped
