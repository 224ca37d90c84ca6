"""Shading by what is known of a surface, in Dr.Jit kernels (:mod:`mbtf_fit.ops.shade`)."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit import ops
from mbtf_fit.backends.mitsuba.backend import MITSUBA, Loader, Numbers, Step, opaque
from mbtf_fit.backends.mitsuba.stored_material import F32
from mbtf_fit.backends.mitsuba.textures import GROUP, Textures
from mbtf_fit.material.format import WEIGHTS_NAME
from mbtf_fit.ops.constants import AZIMUTHS, DIFFUSE_CHANNELS, GLOSSY_CHANNELS
from mbtf_gen.engine.types import Color3f, Float, Normal3f, Point2f, Vector3f


@MITSUBA.implements(ops.Shade)
def _shade(op: ops.Shade, loader: Loader) -> Step:
    finer = Lattice(loader.lattice.finest + 1, loader.lattice.aspect)
    grids = [finer.shape(s) for s in range(finer.finest + 1)]
    first = loader.stored.tensors.get(f"{op.maps}.0", np.empty((1, 1, GLOSSY_CHANNELS)))
    channels = first.shape[-1]
    if channels not in (DIFFUSE_CHANNELS, GLOSSY_CHANNELS):
        raise InputError(
            f"its tensors '{op.maps}' have neither {DIFFUSE_CHANNELS} nor {GLOSSY_CHANNELS} channels",
            where=loader.stored.folder / WEIGHTS_NAME,
        )
    maps = loader.texture(op.maps, grids, channels)
    horizons = Textures(
        [_adjacent_azimuths(level) for level in loader.levels(op.horizons, grids[:-1], 2 * AZIMUTHS)],
        by_group=True,
    )
    width, dielectric = loader.scalar(op.light_width), opaque(loader.scalar(op.dielectric))
    blur, widening = opaque((op.light_blur * width) ** 2), opaque(width**2)

    def visibility(hit: Point2f, level: Float, omega_i: Vector3f) -> Float:
        """Share of footprints from which the light is visible."""
        count = horizons.groups
        azimuth = dr.atan2(omega_i.y, omega_i.x) * (count / (2.0 * math.pi))
        azimuth -= count * dr.floor(azimuth / count)
        before = dr.minimum(mi.UInt32(azimuth), count - 1)
        numbers = horizons.blended(hit, level, before)
        weight = azimuth - mi.Float(before)
        mean, square = (dr.lerp(numbers[k], numbers[k + 2], weight) for k in (0, 1))
        variance = dr.maximum(square - dr.square(mean), 0.0) + blur
        elevation = dr.asin(dr.clip(omega_i.z, 0.0, 1.0))
        deviations = (elevation - mean) * dr.rsqrt(2.0 * dr.maximum(variance, op.least_variance))
        return dr.fma(0.5, dr.erf(deviations), 0.5)

    def at(hit: Point2f, found: Numbers, level: Float, omega_i: Vector3f, omega_o: Vector3f) -> Numbers:
        x, y, square, *rest = found
        normal, base = _normal(x, y), mi.Color3f(*rest[:3])
        light = dr.dot(normal, omega_i)
        irradiance = visibility(hit, level, omega_i) * dr.maximum(light, 0.0) / omega_i.z
        value = base / math.pi
        if channels == GLOSSY_CHANNELS:
            own, metallic = rest[3:]
            variance = dr.maximum(square - dr.fma(x, x, dr.square(y)), 0.0)
            alpha2 = dr.clip(own + variance + widening, *op.alpha2)
            f0 = dr.lerp(mi.Color3f(dielectric), base, metallic)
            value = (1.0 - metallic) * value + _ggx(op, f0, alpha2, normal, omega_i, omega_o)
        return [irradiance, normal.x, normal.y, *(irradiance * value)]

    def step(hits: Numbers, level: Numbers, omega_i: Numbers, omega_o: Numbers) -> Numbers:
        places = [mi.Point2f(*hits[k : k + 2]) for k in range(0, len(hits), 2)]
        common = (level[0] + op.finer, mi.Vector3f(*omega_i), mi.Vector3f(*omega_o))
        read = [maps.blended(hit, common[0]) for hit in places]
        # A basic block of its own: four places in one spill registers, which takes 5 % of the kernel's time.
        dr.detail.new_scope(dr.backend_v(mi.Float))
        parts = [at(hit, found, *common) for hit, found in zip(places, read, strict=True)]
        return [sum(column) / len(parts) for column in zip(*parts, strict=True)]

    return step


@MITSUBA.implements(ops.Lobe)
def _lobe(op: ops.Lobe, loader: Loader) -> Step:
    def step(base: Numbers, specular: Numbers, alpha2: Numbers, slopes: Numbers, *omega: Numbers) -> Numbers:
        light, view = (mi.Vector3f(*w) for w in omega)
        normal = _normal(*slopes)
        roughness = dr.maximum(alpha2[0], op.least_alpha2)
        lobe = _ggx(op, mi.Color3f(*specular), roughness, normal, light, view)
        irradiance = dr.maximum(dr.dot(normal, light), 0.0) / light.z
        return list(irradiance * (mi.Color3f(*base) / math.pi + lobe))

    return step


def _normal(x: Float, y: Float) -> Normal3f:
    """Unit normal of slopes."""
    return dr.normalize(mi.Normal3f(-x, -y, 1.0))


def _adjacent_azimuths(horizons: F32) -> F32:
    """Horizons (rows, columns, 2n), means and then squares, as n groups of four: mean and square of an
    azimuth, and of the next one."""
    mean, square = np.split(horizons, 2, axis=2)
    parts = (mean, square, np.roll(mean, -1, 2), np.roll(square, -1, 2))
    return np.stack(parts, -1).reshape(*mean.shape[:2], GROUP * mean.shape[2])


def _ggx(
    op: ops.Shade | ops.Lobe,
    f0: Color3f,
    alpha2: Float,
    normal: Normal3f,
    omega_i: Vector3f,
    omega_o: Vector3f,
) -> Color3f:
    """BRDF of GGX facets of reflectance F0 and α² (Walter et al. 2007; Schlick 1994)."""
    light = dr.maximum(dr.dot(normal, omega_i), op.least_light)
    view = dr.maximum(dr.dot(normal, omega_o), op.least_view)
    half = dr.normalize(omega_i + omega_o)
    cosine = dr.maximum(dr.dot(normal, half), 0.0)
    facets = alpha2 / (math.pi * dr.square(dr.fma(dr.square(cosine), alpha2 - 1.0, 1.0)))
    masking = sum(dr.sqrt(dr.fma(alpha2, dr.rcp(dr.square(c)) - 1.0, 1.0)) for c in (light, view))
    schlick = (1.0 - dr.clip(dr.dot(omega_o, half), 0.0, 1.0)) ** 5
    return (f0 + (1.0 - f0) * schlick) * facets / (2.0 * masking * light * view)
