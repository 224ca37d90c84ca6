"""Shading by what is known of a surface, in Dr.Jit kernels (:mod:`mbtf_fit.ops.shade`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_core.errors import InputError
from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.arcs import on_top, tilt
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step, opaque
from mbtf_fit.backends.mitsuba.curvature import DEEPEST
from mbtf_fit.backends.mitsuba.frame import Frame
from mbtf_fit.backends.mitsuba.shell import displaced
from mbtf_fit.backends.mitsuba.textures import Textures
from mbtf_fit.backends.mitsuba.view_rays import heights_below
from mbtf_fit.material.format import WEIGHTS_NAME
from mbtf_fit.ops.constants import (
    ALBEDO_SPREAD,
    AZIMUTHS,
    COATED_CHANNELS,
    DIFFUSE_CHANNELS,
    GLOSSY_CHANNELS,
    MAP_CHANNELS,
    MAX_CROSSINGS,
    VOIGT_SCALE,
    VOIGT_WIDENING,
)
from mbtf_fit.ops.shade import adjacent_azimuths, grazing_reflectance
from mbtf_gen.engine.types import Color3f, Float, Mask, Normal3f, Point2f, Vector2f, Vector3f

# Height of what shadows a place, as a share of the way up to the top of the shell: of five height fields,
# 0.26 to 0.36 in the mean, and 0.42 to 0.58 weighted by its distance. Depth of the surroundings of a high
# place, as a share of the way down to the bottom.
OCCLUDER, SURROUNDINGS = 0.4, 0.3
# Least and largest elevation of a horizon; largest distance to it in tile widths.
LEAST_HORIZON, HIGHEST, FARTHEST = 1e-3, 1.55, 1.0


@dataclass(frozen=True)
class DirectLight:
    """Light over a curved surface, where horizons are not those of the plane.

    Attributes
    ----------
    omega_i : towards the light, also below the plane
    least : smallest cosine of the data
    flat : where the light is as on a plane
    curvature : of the surface, along the tile's axes (xx, xy, yy)
    depth, heights : of the shell, and of each place
    """

    omega_i: Vector3f
    least: Float
    flat: Mask
    curvature: Vector3f
    depth: Float
    heights: Sequence[Float]

    @property
    def bend(self) -> Float:
        """Curvature along the light's azimuth."""
        flat = mi.Vector2f(self.omega_i.x, self.omega_i.y)
        return dr.dot(tilt(self.curvature, flat), flat) / dr.maximum(dr.squared_norm(flat), 1e-12)

    def dip(self, drop: Float) -> Float:
        """Sine of the angle by which the horizon is below the plane, at a height over a sphere."""
        deep = dr.clip(self.bend * drop, 0.0, DEEPEST)
        return dr.sqrt(deep * (2.0 - deep))

    @property
    def lowest(self) -> Float:
        """Elevation of the horizon from the top of the shell, the lowest of all."""
        return -dr.asin(self.dip(self.depth))

    @property
    def reach(self) -> Float:
        """Cosine of the light, from 0 at the lowest horizon to 1 at the least of the data."""
        dip = self.dip(self.depth)
        return dr.clip((self.omega_i.z + dip) / (self.least + dip), 0.0, 1.0)

    @property
    def known(self) -> Float:
        """Share of the light that others scatter, of that at the least cosine of the data."""
        return dr.select(self.flat, 1.0, dr.square(self.reach))

    def horizon(self, plane: Float, place: int) -> Float:
        """Elevation of the horizon, from that over a plane. At a distance s, the surface has sunk by
        κ s²/2, and with it what shadows the place, which is nearer below the top. No horizon is below that
        of the surroundings."""
        height, bend = self.heights[place], self.bend
        angle = dr.clip(plane, LEAST_HORIZON, HIGHEST)
        slope = dr.tan(angle)
        distance = dr.minimum(-OCCLUDER * height / slope, FARTHEST)
        sunk = slope / dr.fma(bend, (1.0 - OCCLUDER) * height, 1.0) - 0.5 * bend * distance
        dip = self.dip(SURROUNDINGS * dr.maximum(self.depth + height, 0.0))
        bent = dr.maximum(sunk, -dip * dr.rsqrt(1.0 - dip * dip))
        return dr.select(self.flat, plane, plane + dr.atan(bent) - angle)


@MITSUBA.implements(ops.Shade)
def _shade(op: ops.Shade, loader: Loader) -> Step:
    first = loader.stored.tensors.get(f"{op.maps}.0", np.empty((1, 1, GLOSSY_CHANNELS)))
    channels = first.shape[-1]
    if channels not in MAP_CHANNELS:
        raise InputError(
            f"its tensors '{op.maps}' have {channels} channels in place of "
            f"{DIFFUSE_CHANNELS}, {GLOSSY_CHANNELS} or {COATED_CHANNELS}",
            where=loader.stored.folder / WEIGHTS_NAME,
        )
    maps = loader.maps(op.maps, channels)
    levels = loader.levels(op.horizons, loader.grids(), 2 * AZIMUTHS)
    horizons = Textures([adjacent_azimuths(level) for level in levels], by_group=True)
    width, f0 = loader.scalar(op.light_width), loader.scalar(op.dielectric)
    dielectric, grazing = opaque(f0), opaque(grazing_reflectance(f0))
    blur, width2 = opaque((op.light_blur * width) ** 2), opaque(width**2)

    def lower_horizons(
        hit: Point2f, level: Float, omega_i: Vector3f, lit: DirectLight | None, place: int
    ) -> Float:
        """(R2) Share of the horizons of footprints that are lower than the light."""
        count = horizons.groups
        azimuth = dr.atan2(omega_i.y, omega_i.x) * (count / (2.0 * math.pi))
        azimuth -= count * dr.floor(azimuth / count)
        before = dr.minimum(mi.UInt32(azimuth), count - 1)
        numbers = horizons.blended(hit, level, before)
        weight = azimuth - mi.Float(before)
        mean, square = (dr.lerp(numbers[k], numbers[k + 2], weight) for k in (0, 1))
        variance = dr.maximum(square - dr.square(mean), 0.0) + blur
        if lit is not None:
            mean = lit.horizon(mean, place)
        elevation = dr.asin(dr.clip(omega_i.z, 0.0 if lit is None else -1.0, 1.0))
        scale = dr.rsqrt(2.0 * dr.maximum(variance, op.least_variance))

        def lower(elevation: Float) -> Float:
            """Share of the footprint's horizons that are lower."""
            return dr.fma(0.5, dr.erf((elevation - mean) * scale), 0.5)

        visible = lower(elevation)
        if lit is None:
            return visible
        # No horizon is below the lowest one, as the Gaussian has them.
        inside = dr.maximum(visible - (1.0 - lit.reach) * lower(lit.lowest), 0.0)
        return dr.select(lit.flat, visible, inside)

    def visibilities(
        hits: Sequence[Point2f],
        depths: Numbers | None,
        level: Float,
        omega_i: Vector3f,
        towards: Vector3f,
        lit: DirectLight | None,
    ) -> list[Float]:
        """Visibility of the light from each place: on a plane also by shadow rays (R11)."""
        lower = [lower_horizons(hit, level, towards, lit, k) for k, hit in enumerate(hits)]
        if op.heights is None or depths is None:
            return lower
        flat = mi.Mask(True) if lit is None else lit.flat
        aspect = loader.lattice.aspect
        tops = (displaced(hit, -z, omega_i, aspect) for hit, z in zip(hits, depths, strict=True))
        rays = [mi.Ray3f(on_top(top, aspect), -omega_i) for top in tops]
        found = heights_below(loader.heightfield(op.heights), rays, MAX_CROSSINGS, flat)
        rate = -dr.rcp(omega_i.z * op.light_depth)
        lit_by_ray = (dr.exp(rate * dr.maximum(top - z, 0.0)) for top, z in zip(found, depths, strict=True))
        return [dr.select(flat, 0.5 * (a + b), a) for a, b in zip(lower, lit_by_ray, strict=True)]

    def at(
        found: Numbers,
        seen: Float,
        omega_i: Vector3f,
        towards: Vector3f,
        omega_o: Vector3f,
        frame: Frame | None,
        lit: DirectLight | None,
        place: int,
    ) -> Numbers:
        x, y, *moments = found[:5]
        center, spread, base = mi.Vector2f(x, y), _spread(x, y, *moments), mi.Color3f(*found[5:8])
        upright = dr.rsqrt(1.0 + dr.squared_norm(center))
        light = seen / omega_i.z
        facing = light * _shown(towards, center, spread)
        hints = [upright * facing, -upright * x, -upright * y]
        if frame is not None:
            # A stretched tile has facets of other slopes. Areas that they show stay in proportion.
            light *= frame.length(towards)
            sag = None if lit is None else lit.heights[place] * lit.curvature
            center, spread = frame.slope(center, sag), frame.spread(spread, sag)
            towards, omega_i, omega_o = (frame.on_surface(w) for w in (towards, omega_i, omega_o))
            facing = light * _shown(towards, center, spread)
            x, y = center
        length2 = dr.squared_norm(center)
        upright = dr.rsqrt(1.0 + length2)
        core = facing * upright * base / math.pi
        if channels == DIFFUSE_CHANNELS:
            return [*hints, *core]
        half = dr.normalize(omega_i + omega_o)
        rest = _schlick(dr.dot(omega_o, half))
        widening = _light_widening(omega_i, omega_o, width2)

        cosines = [
            dr.minimum(upright * _projections(omega, center, spread)[1], 1.0) for omega in (omega_i, omega_o)
        ]

        def lobe(alpha2: Float) -> Float:
            """(R5) Light that facets of reflectance 1 reflect."""
            below = dr.rcp(dr.fma(alpha2, length2, 1.0))
            kappa, rho = (1.0 - alpha2) * below, alpha2 * (1.0 + length2) * below
            middle = kappa * center
            own = (dr.fma(middle.x, x, 1.0), middle.x * y, dr.fma(middle.y, y, 1.0))
            facets = [dr.fma(rho, a, b) for a, b in zip(own, spread, strict=True)]
            facing = dr.maximum(_shown(omega_o, middle, facets), op.least_view)
            lit = light * _own_shadowing(alpha2, *cosines)
            return lit * _density(half, middle, facets, widening, alpha2) / (4.0 * facing)

        metallic = found[9]
        f0, f90 = dr.lerp(mi.Color3f(dielectric), base, metallic), dr.fma(metallic, 1.0 - grazing, grazing)
        alpha2 = dr.clip(found[8], *op.alpha2)
        left, mean = _left(dielectric, grazing, alpha2, cosines)
        core = (1.0 - metallic) * left / mean * core + (f0 + (f90 - f0) * rest) * lobe(alpha2)
        if channels == COATED_CHANNELS:
            weight, alpha2 = found[10], dr.clip(found[11], *op.alpha2)
            core *= _left(CLEARCOAT_F0 * weight, weight, alpha2, cosines)[0]
            core += weight * dr.fma(1.0 - CLEARCOAT_F0, rest, CLEARCOAT_F0) * lobe(alpha2)
        return [*hints, *core]

    def step(
        hits: Numbers,
        level: Numbers,
        omega_i: Numbers,
        omega_o: Numbers,
        depths: Numbers | None,
        frame: Frame | None = None,
        lit: DirectLight | None = None,
    ) -> Numbers:
        places = [mi.Point2f(*hits[k : k + 2]) for k in range(0, len(hits), 2)]
        finer, light, view = level[0] + op.finer, mi.Vector3f(*omega_i), mi.Vector3f(*omega_o)
        towards = light if lit is None else dr.select(lit.flat, light, lit.omega_i)
        seen = visibilities(places, depths, finer, light, towards, lit)
        read = [maps.blended(hit, finer) for hit in places]
        # A basic block of its own: four places in one spill registers, which takes 5% of the kernel's time.
        dr.detail.new_scope(dr.backend_v(mi.Float))
        shared = (light, towards, view, frame, lit)
        parts = [at(read[k], seen[k], *shared, k) for k in range(len(places))]
        return [sum(column) / len(parts) for column in zip(*parts, strict=True)]

    return step


@MITSUBA.implements(ops.Lobe)
def _lobe(op: ops.Lobe, loader: Loader) -> Step:
    def step(
        base: Numbers,
        specular: Numbers,
        alpha2: Numbers,
        slopes: Numbers,
        omega_i: Numbers,
        omega_o: Numbers,
        weight: Numbers | None,
    ) -> Numbers:
        light, view = mi.Vector3f(*omega_i), mi.Vector3f(*omega_o)
        normal = dr.normalize(mi.Normal3f(-slopes[0], -slopes[1], 1.0))
        roughness = dr.maximum(alpha2[0], op.least_alpha2)
        lobe = _ggx(op, mi.Color3f(*specular), roughness, normal, light, view)
        if weight is not None:
            lobe *= weight[0]
        irradiance = dr.maximum(dr.dot(normal, light), 0.0) / light.z
        return list(irradiance * (mi.Color3f(*base) / math.pi + lobe))

    return step


def _spread(x: Float, y: Float, xx: Float, xy: Float, yy: Float) -> tuple[Float, Float, Float]:
    """2C (xx, xy, yy) of a center and moments."""
    xx, xy, yy = dr.fma(-x, x, xx), dr.fma(-x, y, xy), dr.fma(-y, y, yy)
    xx, yy = dr.maximum(xx, 0.0), dr.maximum(yy, 0.0)
    most = dr.sqrt(xx * yy)
    return 2.0 * xx, 2.0 * dr.clip(xy, -most, most), 2.0 * yy


def _projections(omega: Vector3f, center: Vector2f, matrix: Sequence[Float]) -> tuple[Float, Float]:
    """(R4) Twice both terms of :func:`_shown`."""
    xx, xy, yy = matrix
    p = omega.z - center.x * omega.x - center.y * omega.y
    square = xx * dr.square(omega.x) + 2.0 * xy * omega.x * omega.y + yy * dr.square(omega.y)
    return p, dr.sqrt(dr.maximum(dr.fma(p, p, square), 1e-20))


def _shown(omega: Vector3f, center: Vector2f, matrix: Sequence[Float]) -> Float:
    """(R4) Area that facets show to a direction, per area of the reference plane."""
    p, root = _projections(omega, center, matrix)
    return 0.5 * (p + root)


def _light_widening(omega_i: Vector3f, omega_o: Vector3f, width2: Float) -> tuple[Float, Float, Float]:
    """Covariance W (xx, xy, yy) of the slopes of half vectors, by the light's variance per axis."""
    both = omega_i + omega_o
    up = dr.rcp(both.z)
    x, y = -both.x * up, -both.y * up
    p, q = dr.fma(omega_i.z, x, omega_i.x), dr.fma(omega_i.z, y, omega_i.y)
    scale = width2 * dr.square(up)
    return scale * (1.0 + x * x - p * p), scale * (x * y - p * q), scale * (1.0 + y * y - q * q)


def _density(
    half: Vector3f, center: Vector2f, matrix: Sequence[Float], widening: Sequence[Float], least: Float
) -> Float:
    """Density D(h) of facets per area of the reference plane, averaged over the light."""
    x, y = dr.fma(half.z, center.x, half.x), dr.fma(half.z, center.y, half.y)
    up2 = dr.square(half.z)

    def inverse(matrix: Sequence[Float]) -> tuple[Float, Float]:
        """Root of the determinant, and gᵀ B⁻¹ g."""
        xx, xy, yy = matrix
        determinant = dr.maximum(xx * yy - xy * xy, 0.25 * least * (xx + yy))
        square = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
        return dr.sqrt(determinant), dr.maximum(square, 0.0)

    def combined(a: Sequence[Float], factor: Float | float, b: Sequence[Float]) -> list[Float]:
        return [dr.fma(factor, y, x) for x, y in zip(a, b, strict=True)]

    light = dr.sqrt(dr.maximum(widening[0] * widening[2] - dr.square(widening[1]), 1e-20))
    own, _ = inverse(matrix)
    wide, distance = inverse(combined(matrix, VOIGT_WIDENING, widening))
    share = own / wide
    factor = VOIGT_SCALE + 0.5 * dr.rcp(own / light + VOIGT_SCALE)
    narrow, deviations = inverse(combined(widening, factor, matrix))
    gaussian = dr.exp(-0.5 * deviations / up2) / (2.0 * narrow * dr.square(up2))
    return (share / (wide * dr.square(up2 + distance)) + (1.0 - share) * gaussian) / math.pi


def _schlick(cosine: Float) -> Float:
    """Weight of the grazing reflectance (Schlick 1994)."""
    return (1.0 - dr.clip(cosine, 0.0, 1.0)) ** 5


def _left(f0: Float, f90: Float, alpha2: Float, cosines: Sequence[Float]) -> tuple[Float, Float]:
    """(R6, R9) Energy that a lobe of α² leaves of both directions, by their cosines; its mean over one."""
    added = alpha2 / dr.fma(ALBEDO_SPREAD[1], dr.sqrt(alpha2), ALBEDO_SPREAD[0])
    t = 1.0 - dr.sqrt(added)
    mean = 2.0 * t**6 * (1.0 / 6.0 - t / 7.0) / (1.0 - added)
    a, b = (_schlick(dr.sqrt(dr.fma(added, 1.0 - dr.square(x), dr.square(x)))) for x in cosines)
    a, b, mean = (1.0 - f0 - (f90 - f0) * weight for weight in (a, b, mean))
    return a * b, mean


def _own_shadowing(alpha2: Float, light: Float, view: Float) -> Float:
    """(R10) Share of the facets of α² in the light, of those that the viewer sees, by both cosines."""
    a, b = (dr.sqrt(dr.fma(1.0 - alpha2, dr.square(x), alpha2)) for x in (light, view))
    return light * (view + b) / dr.fma(light, b, view * a)


def _ggx(
    op: ops.Lobe, f0: Color3f, alpha2: Float, normal: Normal3f, omega_i: Vector3f, omega_o: Vector3f
) -> Color3f:
    """BRDF of GGX facets of reflectance F0 and α² (Walter et al. 2007; Schlick 1994)."""
    light = dr.maximum(dr.dot(normal, omega_i), op.least_light)
    view = dr.maximum(dr.dot(normal, omega_o), op.least_view)
    half = dr.normalize(omega_i + omega_o)
    cosine = dr.maximum(dr.dot(normal, half), 0.0)
    facets = alpha2 / (math.pi * dr.square(dr.fma(dr.square(cosine), alpha2 - 1.0, 1.0)))
    masking = sum(dr.sqrt(dr.fma(alpha2, dr.rcp(dr.square(c)) - 1.0, 1.0)) for c in (light, view))
    reflectance = f0 + (1.0 - f0) * _schlick(dr.dot(omega_o, half))
    return reflectance * facets / (2.0 * masking * light * view)
