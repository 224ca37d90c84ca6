"""``mbtf_path``: a path tracer that carries ray cones, so that ``mbtf`` knows its footprint at every hit.

A cone has a width, the side of the square that a pixel covers across the ray, and a spread, by which the
width grows per unit of length (Amanatides 1984; Akenine-Möller et al. 2019). Both start from the sensor's ray
differentials, whole pixels. At a hit the square projected onto the surface is written to ``si.duv_dx`` and
``si.duv_dy``; stock integrators leave these at zero. Surfaces are taken as flat: curvature does not widen
the cone. A scattered ray's cone is at least as wide as the density of its direction calls for.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_core.errors import UsageError
from mbtf_fit.mitsuba_plugin.bsdf import FOOTPRINTS_PASSED
from mbtf_fit.mitsuba_plugin.registration import INTEGRATOR_NAME, refuse_unknown
from mbtf_fit.mitsuba_plugin.scene import check_scene

# Spread of a scattered ray's cone, as a share of 1/√density, the side of the solid angle that a direction of
# that density stands for.
SCATTERED = 0.25


def write_footprint(si: Any, ray: Any, width: Any) -> Any:
    """`si` with the uv partials of a square of side `width` across the ray, projected onto the surface."""
    si = type(si)(si)
    cosine = dr.maximum(dr.abs(dr.dot(si.n, ray.d)), 1e-3)
    across = mi.Frame3f(mi.Vector3f(si.n)).to_local(ray.d)
    flat = mi.Vector2f(across.x, across.y)
    length = dr.norm(flat)
    flat = dr.select(length > 1e-6, flat / length, mi.Vector2f(1.0, 0.0))
    frame = mi.Frame3f(mi.Vector3f(si.n))
    along = frame.to_world(mi.Vector3f(flat.x, flat.y, 0.0)) * (width / cosine)
    beside = frame.to_world(mi.Vector3f(-flat.y, flat.x, 0.0)) * width
    # Least squares on ∂p/∂u, ∂p/∂v.
    e, f, g = dr.squared_norm(si.dp_du), dr.dot(si.dp_du, si.dp_dv), dr.squared_norm(si.dp_dv)
    determinant = e * g - f * f
    inverse = dr.select(determinant > 0, 1.0 / determinant, 0.0)

    def partials(step: Any) -> Any:
        a, b = dr.dot(si.dp_du, step), dr.dot(si.dp_dv, step)
        return mi.Vector2f((g * a - f * b) * inverse, (e * b - f * a) * inverse)

    si.duv_dx, si.duv_dy = partials(along), partials(beside)
    return si


def camera_cone(ray: Any, samples: int) -> tuple[Any, Any]:
    """(width, spread) of a sensor's ray whose differentials the renderer has divided by √samples."""
    scale = float(samples) ** 0.5
    width = dr.cross(ray.o_x - ray.o, ray.o_y - ray.o)
    spread = dr.cross(ray.d_x - ray.d, ray.d_y - ray.d)
    return tuple(scale * dr.sqrt(dr.abs(dr.dot(area, ray.d))) for area in (width, spread))


def lets_through(scene: Any) -> bool:
    """Whether light may pass straight through a surface of the scene; True where that cannot be told."""
    surfaces = [shape.bsdf() for shape in scene.shapes()]
    return any(bsdf is None or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in surfaces)


class ConePath(mi.SamplingIntegrator):
    """Path tracing with emitter sampling and multiple importance sampling, with ray cones.

    Plugin parameters
    -----------------
    max_depth : longest path in segments; 1 shows emitters alone, 2 direct light; -1: no limit (default)
    rr_depth : segments after which Russian roulette begins (default 5)
    hide_emitters : the camera does not see emitters (default false)
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        depth = int(props.get("max_depth", -1))
        self.max_depth = 0xFFFFFFFF if depth < 0 else depth
        self.rr_depth = int(props.get("rr_depth", 5))
        if depth < -1 or self.rr_depth < 1:
            raise UsageError("max_depth must be at least -1, rr_depth at least 1", where=INTEGRATOR_NAME)
        self.hidden = bool(props.get("hide_emitters", False))
        refuse_unknown(props, ("max_depth", "rr_depth", "hide_emitters"), INTEGRATOR_NAME)

    def render(self, scene: Any, *arguments: Any, **options: Any) -> Any:
        """Stock rendering, after a check of the scene.

        Raises
        ------
        InputError : a mesh with an ``mbtf`` material has no texture coordinates
        """
        check_scene(scene)
        return super().render(scene, *arguments, **options)

    def sample(
        self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
    ) -> tuple[Any, Any, list[Any]]:
        """Radiance along a camera ray, whether it met a surface, no further channels."""
        width, spread = camera_cone(ray, sampler.sample_count())
        token = FOOTPRINTS_PASSED.set(True)
        try:
            first = mi.Ray3f(ray)
            value, valid = self._trace(
                scene, sampler, first, width, spread, mi.Bool(active), lets_through(scene)
            )
        finally:
            FOOTPRINTS_PASSED.reset(token)
        return value, valid, []

    @dr.syntax
    def _trace(
        self, scene: Any, sampler: Any, ray: Any, width: Any, spread: Any, active: Any, holes: bool
    ) -> tuple[Any, Any]:
        radiance, throughput = mi.Spectrum(0.0), mi.Spectrum(1.0)
        depth, eta = mi.UInt32(0), mi.Float(1.0)
        pdf, specular = mi.Float(1.0), mi.Bool(True)
        last = dr.zeros(mi.Interaction3f)
        valid = mi.Bool((not self.hidden) and scene.environment() is not None)
        hidden, most, roulette = mi.Bool(self.hidden), mi.UInt32(self.max_depth), mi.UInt32(self.rr_depth)
        context = mi.BSDFContext()
        while active:
            si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 0, active)
            width = dr.fma(spread, dr.select(si.is_valid(), si.t, 0.0), width)
            # Light that the ray meets.
            emitter = si.emitter(scene)
            seen = active & (emitter != None) & ~((depth == 0) & hidden)  # noqa: E711
            ds = mi.DirectionSample3f(scene, si, last)
            other = scene.pdf_emitter_direction(last, ds, seen & ~specular)
            weight = dr.select(specular, 1.0, pdf / (pdf + other))
            radiance[seen] += throughput * weight * emitter.eval(si, seen)
            valid |= (depth == 0) & si.is_valid()
            active &= si.is_valid() & (depth + 1 < most)
            # Light from a sampled emitter.
            si = write_footprint(si, ray, width)
            bsdf = si.bsdf()
            smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, light = scene.sample_emitter_direction(si, sampler.next_2d(active), not holes, smooth)
            smooth &= ds.pdf > 0
            if dr.hint(holes, mode="scalar"):
                light *= self._through(scene, si, ds, width, smooth)
            wo = si.to_local(ds.d)
            value, density = bsdf.eval_pdf(context, si, wo, smooth)
            weight = dr.select(ds.delta, 1.0, ds.pdf / (ds.pdf + density))
            radiance[smooth] += throughput * value * light * weight
            # The next direction.
            bs, factor = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
            throughput *= factor
            eta *= bs.eta
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            through = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            last = dr.select(active & ~through, mi.Interaction3f(si), last)
            pdf = dr.select(through, pdf, bs.pdf)
            specular = dr.select(through, specular, delta)
            spread = dr.select(
                delta | through | ~active,
                spread,
                dr.maximum(spread, SCATTERED * dr.rsqrt(dr.maximum(bs.pdf, 1e-6))),
            )
            ray = si.spawn_ray(si.to_world(bs.wo))
            depth[si.is_valid()] += 1
            most_left = dr.max(throughput)
            keep = dr.minimum(most_left * dr.square(eta), 0.95)
            played = depth >= roulette
            throughput[played] *= dr.rcp(dr.maximum(keep, 1e-6))
            active &= (most_left != 0.0) & (~played | (sampler.next_1d(active) < keep))
        return radiance, valid

    @dr.syntax
    def _through(self, scene: Any, si: Any, ds: Any, width: Any, active: Any) -> Any:
        """Share of an emitter's light that reaches a hit, through the holes of what lies between."""
        share, active = mi.Spectrum(1.0), mi.Bool(active)
        ray = si.spawn_ray_to(ds.p)
        while active:
            hit = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
            active &= hit.is_valid()
            bsdf = hit.bsdf()
            passes = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            # As wide as where the light arrives: what is near is seen as it is there.
            hit = write_footprint(hit, ray, width)
            share[active] *= dr.select(passes, bsdf.eval_null_transmission(hit, passes), 0.0)
            active &= dr.max(share) > 0.0
            ray = hit.spawn_ray_to(ds.p)
        return share
