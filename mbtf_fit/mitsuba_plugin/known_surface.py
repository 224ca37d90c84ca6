"""The known surface of the model `relief` in Dr.Jit kernels; :mod:`mbtf_fit.surface.known` explains it."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_core.data.lattice import Lattice
from mbtf_fit.mitsuba_plugin.material_arrays import F32, StoredSurface
from mbtf_fit.mitsuba_plugin.textures import GROUP, Textures
from mbtf_fit.ops.constants import (
    ALPHA2,
    GLOSSY_CHANNELS,
    LEAST_LIGHT,
    LEAST_VARIANCE,
    LEAST_VIEW,
    LIGHT_BLUR,
    MAX_CROSSINGS,
    PLACES,
)
from mbtf_gen.engine.types import Float, Normal3f, Point2f, Vector3f
from mbtf_gen.tile.heights.grid import HeightGrid
from mbtf_gen.tile.tracers.heightfield import HeightField
from mbtf_gen.tile.tracers.heightfield_tracer import closest_height


class KnownSurface:
    """Heights, maps and horizons of a material; the texels of its `maps` may be changed.

    Parameters
    ----------
    stored : of the material
    lattice : texel grids of the tile
    places : view rays per footprint
    """

    def __init__(self, stored: StoredSurface, lattice: Lattice, places: int) -> None:
        self._aspect = lattice.aspect
        self._offsets, self._finer = PLACES[places]
        grid = HeightGrid(stored.heights.astype(np.float64), lattice.aspect)
        self._heightfield = HeightField.of(grid, 1.0, two_sided=False)
        self.maps = Textures(stored.maps)
        pairs = [adjacent_azimuths(level) for level in stored.horizons]
        self._horizons = Textures(pairs, by_group=True)
        self._light_width, self._dielectric = stored.light_width, stored.dielectric

    @property
    def numbers(self) -> int:
        """Numbers of :meth:`intersections` per place."""
        return 2 + self.maps.channels

    def height(self, u: Point2f, omega_o: Vector3f) -> Float:
        """Heights in tile widths at which lines through points of the plane meet the surface."""
        x, y = u.x - dr.floor(u.x), u.y - dr.floor(u.y)
        ray = mi.Ray3f(mi.Point3f(x - 0.5, (y - 0.5) * self._aspect, 0.0), -omega_o)
        return closest_height(self._heightfield, ray, MAX_CROSSINGS)

    def intersections(self, u: Point2f, level: Float, omega_o: Vector3f) -> tuple[Float, list[Float]]:
        """Stage 1: mean height over the places; of each place uv of the intersection, then the maps there."""
        sigma = 0.5 * dr.exp2(-level)
        total, out = mi.Float(0.0), []
        along = azimuth(omega_o)
        for x, y in self._offsets:
            step = sigma * mi.Vector2f(y * along.x - x * along.y, (y * along.y + x * along.x) / self._aspect)
            at = u + step
            z = self.height(at, omega_o)
            hit = displaced(at, z, omega_o, self._aspect)
            total += z
            out += [hit.x, hit.y, *self.maps.blended(hit, level + self._finer)]
        return total / len(self._offsets), out

    def shading(self, places: list[Float], level: Float, omega_i: Vector3f, omega_o: Vector3f) -> list[Float]:
        """Stage 2: irradiance, normal (x, y), core (RGB), means over the places of :meth:`intersections`."""
        count = self.numbers
        parts = [
            self._shade(places[k : k + count], level + self._finer, omega_i, omega_o)
            for k in range(0, len(places), count)
        ]
        return [sum(column) / len(parts) for column in zip(*parts, strict=True)]

    def _shade(self, place: list[Float], level: Float, omega_i: Vector3f, omega_o: Vector3f) -> list[Float]:
        hit, maps = mi.Point2f(*place[:2]), place[2:]
        normal = dr.normalize(mi.Normal3f(-maps[0], -maps[1], 1.0))
        light = dr.dot(normal, omega_i)
        irradiance = self._visibility(hit, level, omega_i) * dr.maximum(light, 0.0) / omega_i.z
        base = mi.Color3f(*maps[3:6])
        value = base / math.pi
        if len(maps) == GLOSSY_CHANNELS:
            metallic = maps[7]
            variance = dr.maximum(maps[2] - dr.fma(maps[0], maps[0], dr.square(maps[1])), 0.0)
            alpha2 = dr.clip(maps[6] + variance + self._light_width**2, *ALPHA2)
            f0 = dr.lerp(mi.Color3f(self._dielectric), base, metallic)
            value = (1.0 - metallic) * value + ggx(f0, alpha2, normal, omega_i, omega_o)
        return [irradiance, normal.x, normal.y, *(irradiance * value)]

    def _visibility(self, hit: Point2f, level: Float, omega_i: Vector3f) -> Float:
        """Share of footprints from which the light is visible."""
        count = self._horizons.groups
        azimuth = dr.atan2(omega_i.y, omega_i.x) * (count / (2.0 * math.pi))
        azimuth -= count * dr.floor(azimuth / count)
        first = dr.minimum(mi.UInt32(azimuth), count - 1)
        numbers = self._horizons.blended(hit, level, first)
        weight = azimuth - mi.Float(first)
        mean, square = (dr.lerp(numbers[k], numbers[k + 2], weight) for k in (0, 1))
        variance = dr.maximum(square - dr.square(mean), 0.0) + (LIGHT_BLUR * self._light_width) ** 2
        elevation = dr.asin(dr.clip(omega_i.z, 0.0, 1.0))
        return dr.fma(
            0.5, dr.erf((elevation - mean) * dr.rsqrt(2.0 * dr.maximum(variance, LEAST_VARIANCE))), 0.5
        )


def azimuth(omega: Vector3f) -> mi.Vector2f:
    """Unit vectors of the azimuths of directions; (1, 0) of vertical ones."""
    length = dr.sqrt(dr.fma(omega.x, omega.x, dr.square(omega.y)))
    return dr.select(length > 0.0, mi.Vector2f(omega.x, omega.y) / length, mi.Vector2f(1.0, 0.0))


def displaced(u: Point2f, height: Float, omega_o: Vector3f, aspect: float) -> Point2f:
    """uv of the points at heights on lines through points of the plane."""
    step = height / omega_o.z
    return mi.Point2f(dr.fma(step, omega_o.x, u.x), dr.fma(step / aspect, omega_o.y, u.y))


def adjacent_azimuths(horizons: F32) -> F32:
    """Horizons (rows, columns, 2n), means and then squares, as n groups of four: mean and square of an
    azimuth, and of the next one."""
    mean, square = np.split(horizons, 2, axis=2)
    parts = (mean, square, np.roll(mean, -1, 2), np.roll(square, -1, 2))
    return np.stack(parts, -1).reshape(*mean.shape[:2], GROUP * mean.shape[2])


def ggx(f0: mi.Color3f, alpha2: Float, normal: Normal3f, omega_i: Vector3f, omega_o: Vector3f) -> mi.Color3f:
    """BRDF of GGX facets of reflectance F0 and α²: :func:`mbtf_fit.surface.known.ggx`."""
    light = dr.maximum(dr.dot(normal, omega_i), LEAST_LIGHT)
    view = dr.maximum(dr.dot(normal, omega_o), LEAST_VIEW)
    half = dr.normalize(omega_i + omega_o)
    cosine = dr.maximum(dr.dot(normal, half), 0.0)
    facets = alpha2 / (math.pi * dr.square(dr.fma(dr.square(cosine), alpha2 - 1.0, 1.0)))
    masking = sum(dr.sqrt(dr.fma(alpha2, dr.rcp(dr.square(c)) - 1.0, 1.0)) for c in (light, view))
    schlick = (1.0 - dr.clip(dr.dot(omega_o, half), 0.0, 1.0)) ** 5
    return (f0 + (1.0 - f0) * schlick) * facets / (2.0 * masking * light * view)
