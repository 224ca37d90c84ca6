"""``mbtf_path``: a path tracer with ray cones, which give ``mbtf`` its footprint at every hit.

A cone has a width, the side of the square that a sample covers across the ray, and a spread, by which the
width grows per unit of length (Amanatides 1984; Akenine-Möller et al. 2019). The initial values are the
sensor's ray differentials, which Mitsuba divides by √samples: each of the jittered samples of a pixel stands
for its share of the area, and a picture is not blurred twice. At a hit its footprint is the projection of the
square onto the surface, as it is from Mitsuba 3.10 on where camera rays of its own integrators hit. The
curvature of surfaces is neglected. The spread of a scattered ray's cone is bounded below by the density of
its direction.

At grazing angles such a footprint is an ellipse, while those of materials are round. An elongated Gaussian
is the mean of narrow ones along its major axis, so every hit on a surface's material looks up one of them at
random: the mean over samples has the elongated footprint, at the cost of one lookup each.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
from pydantic import Field

from mbtf_core.config.settings import Settings
from mbtf_core.pictures import PIXEL_SIGMA
from mbtf_fit.backends.mitsuba.bsdf import MbtfBSDF, check_scene
from mbtf_fit.backends.mitsuba.curvature import with_normal_partials
from mbtf_fit.backends.mitsuba.names import INTEGRATOR_NAME, footprints_provided, options_of
from mbtf_fit.backends.mitsuba.partials import set_uv_partials, uv_partials
from mbtf_fit.ops.constants import MAX_ANISOTROPY
from mbtf_gen.engine.types import (
    DirectionSample3f,
    Float,
    Mask,
    Properties,
    Ray3f,
    Sampler,
    Scene,
    Spectrum,
    SurfaceInteraction3f,
    Vector2f,
    Vector3f,
)

# Least spread of a scattered ray's cone, relative to 1/√density, the side of the solid angle per sample.
SCATTERED = 0.25


def write_footprint(si: SurfaceInteraction3f, ray: Ray3f, width: Float) -> SurfaceInteraction3f:
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

    def partials(step: Vector3f) -> Vector2f:
        a, b = dr.dot(si.dp_du, step), dr.dot(si.dp_dv, step)
        return mi.Vector2f((g * a - f * b) * inverse, (e * b - f * a) * inverse)

    set_uv_partials(si, partials(along), partials(beside))
    return si


def narrow_footprint(
    si: SurfaceInteraction3f, number: Float, most: Float, active: Mask
) -> SurfaceInteraction3f:
    """`si` at a random one of the round footprints whose mean is the elongated footprint.

    Parameters
    ----------
    si : with uv partials
    number : uniform random number
    most : largest ratio of the radii; of more elongated footprints the minor radius is enlarged
    active : hits to change
    """
    dx, dy = uv_partials(si)
    # Squared semi-axes of the image of the unit circle, and the direction of the major one.
    xx, xy, yy = (
        dr.square(dx.x) + dr.square(dy.x),
        dx.x * dx.y + dy.x * dy.y,
        dr.square(dx.y) + dr.square(dy.y),
    )
    mean, difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
    major = mean + dr.hypot(difference, xy)
    determinant = dr.square(dx.x * dy.y - dx.y * dy.x)
    minor = dr.maximum(dr.select(major > 0, determinant / major, 0.0), major / dr.square(most))
    sin, cos = dr.sincos(0.5 * dr.atan2(xy, difference))
    normal = dr.sqrt(2.0) * dr.erfinv(dr.clip(2.0 * number - 1.0, -0.999999, 0.999999))
    step = PIXEL_SIGMA * dr.sqrt(dr.maximum(major - minor, 0.0)) * normal
    si, side = type(si)(si), dr.sqrt(minor)
    si.uv[active] = si.uv + step * mi.Vector2f(cos, sin)
    narrow = mi.Vector2f(side, 0.0), mi.Vector2f(0.0, side)
    set_uv_partials(si, dr.select(active, narrow[0], dx), dr.select(active, narrow[1], dy))
    return si


def camera_cone(ray: Ray3f) -> tuple[Float, Float]:
    """(width, spread) of a sensor's ray."""
    width = dr.cross(ray.o_x - ray.o, ray.o_y - ray.o)
    spread = dr.cross(ray.d_x - ray.d, ray.d_y - ray.d)
    return tuple(dr.sqrt(dr.abs(dr.dot(area, ray.d))) for area in (width, spread))


def surfaces_of(scene: Scene) -> tuple[bool, bool, list[Any]]:
    """Whether a surface of a scene may transmit light without refraction, and whether one may trace heights
    over its curvature, both True if unknown; and the ``mbtf`` materials, each once, without those inside
    other BSDFs or instances."""
    surfaces = [shape.bsdf() for shape in scene.shapes()]
    materials = [*{id(bsdf): bsdf for bsdf in surfaces if isinstance(bsdf, MbtfBSDF)}.values()]
    passing = [b for b in surfaces if b is None or mi.has_flag(b.flags(), mi.BSDFFlags.Null)]
    unknown = any(not isinstance(bsdf, MbtfBSDF) for bsdf in passing)
    return bool(passing), unknown or any(m.shell is not None for m in materials), materials


class PathOptions(Settings):
    """Parameters of :class:`ConePath`."""

    max_depth: int = Field(-1, ge=-1)
    rr_depth: int = Field(5, ge=1)
    hide_emitters: bool = False
    max_anisotropy: float = Field(MAX_ANISOTROPY, ge=1, le=1024)


class ConePath(mi.SamplingIntegrator):
    """Path tracing with emitter sampling and multiple importance sampling, with ray cones.

    Plugin parameters
    -----------------
    max_depth : longest path in segments; 1 shows emitters alone, 2 direct light; -1: no limit (default)
    rr_depth : segments after which Russian roulette begins (default 5)
    hide_emitters : the camera does not see emitters (default false)
    max_anisotropy : largest ratio of the radii of materials' footprints (default 16); 1: round ones of the
        same area, which blur at grazing angles
    """

    def __init__(self, props: Properties) -> None:
        super().__init__(props)
        options = options_of(props, PathOptions, INTEGRATOR_NAME)
        self.max_depth = 0xFFFFFFFF if options.max_depth < 0 else options.max_depth
        self.rr_depth, self.hidden = options.rr_depth, options.hide_emitters
        self.round = options.max_anisotropy == 1.0
        self.anisotropy = dr.opaque(mi.Float, options.max_anisotropy)

    def render(self, scene: Scene, *arguments: Any, **options: Any) -> Any:
        """Render after a check of the scene.

        Raises
        ------
        InputError : a mesh with an ``mbtf`` material has no texture coordinates
        """
        check_scene(scene)
        return super().render(scene, *arguments, **options)

    def sample(
        self, scene: Scene, sampler: Sampler, ray: Ray3f, medium: Any = None, active: Mask = True
    ) -> tuple[Spectrum, Mask, list[Float]]:
        """Radiance along a camera ray, whether it hit a surface, no further channels."""
        width, spread = camera_cone(ray)
        token = footprints_provided.set(True)
        try:
            cone = (mi.Ray3f(ray), width, spread)
            transmits, curved, materials = surfaces_of(scene)
            known = (transmits, curved, [] if self.round else materials)
            return *self._trace(scene, sampler, *cone, mi.Bool(active), *known), []
        finally:
            footprints_provided.reset(token)

    @dr.syntax
    def _trace(
        self,
        scene: Scene,
        sampler: Sampler,
        ray: Ray3f,
        width: Float,
        spread: Float,
        active: Mask,
        transmits: bool,
        curved: bool,
        materials: list[Any],
    ) -> tuple[Spectrum, Mask]:
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
            # Emitters that the ray hits.
            emitter = si.emitter(scene)
            seen = active & (emitter != None) & ~((depth == 0) & hidden)  # noqa: E711
            ds = mi.DirectionSample3f(scene, si, last)
            other = scene.pdf_emitter_direction(last, ds, seen & ~specular)
            weight = dr.select(specular, 1.0, pdf / (pdf + other))
            radiance[seen] += throughput * weight * emitter.eval(si, seen)
            active &= si.is_valid()
            valid |= active & (most == 1)
            active &= depth + 1 < most
            # Light from a sampled emitter.
            si = write_footprint(si, ray, width)
            if dr.hint(curved, mode="scalar"):
                si = with_normal_partials(si, active)
            bsdf = si.bsdf()
            if dr.hint(bool(materials), mode="scalar"):
                filtered = mi.Bool(False)
                for material in materials:
                    filtered |= bsdf == mi.BSDFPtr(material)
                si = narrow_footprint(si, sampler.next_1d(active), self.anisotropy, filtered)
            smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, light = scene.sample_emitter_direction(si, sampler.next_2d(active), not transmits, smooth)
            smooth &= ds.pdf > 0
            if dr.hint(transmits, mode="scalar"):
                light *= self._transmitted(scene, si, ds, width, smooth, curved)
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
            valid |= active & ~through
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
    def _transmitted(
        self,
        scene: Scene,
        si: SurfaceInteraction3f,
        ds: DirectionSample3f,
        width: Float,
        active: Mask,
        curved: bool,
    ) -> Spectrum:
        """Transmittance of the surfaces between a hit and an emitter."""
        through, active = mi.Spectrum(1.0), mi.Bool(active)
        ray = si.spawn_ray_to(ds.p)
        # Most rays meet no surface, whose hits would cost more.
        active &= scene.ray_test(ray, active)
        while active:
            hit = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
            active &= hit.is_valid()
            bsdf = hit.bsdf()
            passes = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            # The width at the hit: an approximation that is exact for near surfaces.
            hit = write_footprint(hit, ray, width)
            if dr.hint(curved, mode="scalar"):
                hit = with_normal_partials(hit, active)
            through[active] *= dr.select(passes, bsdf.eval_null_transmission(hit, passes), 0.0)
            active &= dr.max(through) > 0.0
            ray = hit.spawn_ray_to(ds.p)
        return through
