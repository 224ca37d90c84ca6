"""The tile as a scene: its geometry, its BSDF, and a Mitsuba sensor whose "pixels" are 7D queries.

The tile is centered on the origin, its longer side is 32 scene units. There single precision resolves 2e-6
units, which suffices for a ray offset of 8e-6 units.

Every sample of the sensor is one ray through a point of the query's Gaussian footprint on the reference
plane, against its view direction. The generator's own loop requests rays by query number. ``mi.render`` calls
``sample_ray``: the n-th pixel of the film, in row order, is the n-th query. The ray's time stores the query's
number, from which :class:`~mbtf_gen.render.directional_light.SmoothedDirectional` finds the query's light.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_core.data.schema import Queries
from mbtf_core.errors import InputError, reason
from mbtf_gen.engine.types import (
    BSDF,
    Float,
    Mask,
    Point2f,
    Properties,
    Ray3f,
    Spectrum,
    UInt32,
    Vector3f,
    padded,
)
from mbtf_gen.render.bsdf.plugin import PartSurface, SurfaceBSDF, surface_of
from mbtf_gen.render.directional_light import SmoothedDirectional
from mbtf_gen.tile.heights import HeightGrid
from mbtf_gen.tile.protocol import Tile
from mbtf_gen.tile.tracers.protocol import TileGeometry

LONG_SIDE = 32.0
# Rays start this far above the reference plane, in units: more than the rounding of the highest vertex.
CLEARANCE = 0.01


def ray_through(point: Point2f, omega_o: Vector3f, unit: Float, aspect: Float, start: Float) -> Ray3f:
    """Ray against ω_o that intersects the reference plane at uv `point`, wrapped into the tile; `unit` scene
    units per tile width, from the height `start` above the plane, in scene units."""
    wrapped = point - dr.floor(point)
    plane = mi.Point3f((wrapped.x - 0.5) * unit, (wrapped.y - 0.5) * (unit * aspect), 0.0)
    return mi.Ray3f(dr.fma(omega_o, start / omega_o.z, plane), -omega_o)


def standard_normal(xi: Point2f) -> Point2f:
    """Sample of the standard normal distribution in the plane, from `xi` in [0,1)².

    It inverts the distribution function of each axis. Unlike polar coordinates (Box-Muller) this is
    continuous, so that low-discrepancy points stay well distributed.
    """
    # Centers of cells of 2^-24: symmetric, and finite after inversion.
    centered = xi * 2.0 - (1.0 - 2.0**-24)
    return dr.sqrt(2.0) * dr.erfinv(centered)


class QuerySensor(mi.Sensor):
    """``mbtf_queries``: rays of a batch of queries.

    Plugin parameters: ``unit`` (scene units per tile width), ``aspect`` (H/W of the tile), ``start`` (height
    above the reference plane, in scene units, at which rays begin), a film and a sampler.
    """

    def __init__(self, props: Properties) -> None:
        super().__init__(props)
        # Opaque, so that all tiles share the compiled kernels.
        self.unit = dr.opaque(mi.Float, float(props.get("unit", 32.0)))
        self.aspect = dr.opaque(mi.Float, float(props.get("aspect", 1.0)))
        self.start = dr.opaque(mi.Float, float(props.get("start", 0.01)))
        self.u = mi.Point2f(0.0)
        self.sigma = mi.Float(0.0)
        self.omega_o = mi.Vector3f(0, 0, 1)

    def set_queries(self, queries: Queries, first: int = 0) -> None:
        """Set a batch of queries (one leading axis); `first` is unused here."""
        self.u = mi.Point2f(padded(queries.u.T))
        self.sigma = mi.Float(padded(queries.sigma))
        self.omega_o = mi.Vector3f(padded(queries.omega_o.T))
        dr.eval(self.u, self.sigma, self.omega_o)

    def footprint(self, query: UInt32, xi: Point2f) -> Point2f:
        """uv of a point of the queries' footprints, not wrapped; `xi` in [0,1)²."""
        u = dr.gather(mi.Point2f, self.u, query)
        sigma = dr.gather(mi.Float, self.sigma, query)
        offset = standard_normal(xi) * sigma
        return mi.Point2f(u + mi.Vector2f(offset.x, offset.y / self.aspect))

    def ray(self, query: UInt32, point: Point2f) -> Ray3f:
        """Ray through uv `point` of the reference plane against the queries' view directions."""
        omega_o = dr.gather(mi.Vector3f, self.omega_o, query)
        return ray_through(point, omega_o, self.unit, self.aspect, self.start)

    def sample_ray(
        self, time: Float, sample1: Float, sample2: Point2f, sample3: Point2f, active: Mask = True
    ) -> tuple[Ray3f, Spectrum]:
        """One ray per sample. The lane gives the query's number; film positions are rounded."""
        paths = self.sampler().sample_count()
        query = dr.minimum(dr.arange(mi.UInt32, dr.width(sample2)) // paths, dr.width(self.sigma) - 1)
        ray = self.ray(query, self.footprint(query, sample3))
        ray.time = mi.Float(query)
        return ray, mi.Color3f(1.0)

    def sample_ray_differential(
        self, time: Float, sample1: Float, sample2: Point2f, sample3: Point2f, active: Mask = True
    ) -> tuple[Any, Spectrum]:
        """As :meth:`sample_ray`, without differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight


def register_plugins() -> None:
    """Register the plugins with Mitsuba's current variant: ``mbtf_queries`` (sensor), ``mbtf_directional``
    (emitter), ``mbtf_surface`` (BSDF)."""
    mi.register_sensor("mbtf_queries", lambda props: QuerySensor(props))
    mi.register_bsdf("mbtf_surface", lambda props: SurfaceBSDF(props))
    mi.register_emitter("mbtf_directional", lambda props: SmoothedDirectional(props))


@dataclass(frozen=True)
class TileScene:
    """A periodic tile as a scene.

    Attributes
    ----------
    aspect : H/W of the tile
    unit : scene units per tile width
    geometry : geometry in scene units
    surface : Surface, PartSurface or MitsubaSurface; reflection, see :mod:`mbtf_gen.render.bsdf.surface`
    """

    aspect: float
    unit: float
    geometry: TileGeometry
    surface: Any


def unit_of(aspect: float) -> float:
    """Scene units per tile width."""
    return LONG_SIDE / max(1.0, aspect)


def build_scene(
    shape: Tile | HeightGrid, bsdf: Mapping[str, Any] | BSDF | Sequence[Mapping[str, Any]]
) -> TileScene:
    """Build the scene of a tile, from a Mitsuba dictionary or a loaded BSDF, or from one dictionary per part
    of a mesh or kind of yarn; an InputError if Mitsuba rejects the BSDF."""
    surface, unit = load_surface(bsdf), unit_of(shape.aspect)
    return TileScene(shape.aspect, unit, shape.trace(unit, surface.transmits), surface)


def load_surface(bsdf: Mapping[str, Any] | BSDF | Sequence[Mapping[str, Any]]) -> Any:
    """Surface, PartSurface or MitsubaSurface of what :func:`build_scene` takes; errors as there."""
    register_plugins()
    if isinstance(bsdf, Sequence):
        return PartSurface([surface_of(_loaded(part)) for part in bsdf])
    return surface_of(_loaded(bsdf) if isinstance(bsdf, Mapping) else bsdf)


def _loaded(bsdf: Mapping[str, Any]) -> BSDF:
    try:
        return mi.load_dict(dict(bsdf))
    except Exception as error:  # whatever the plugins raise about their parameters
        text = re.sub(r"\[\w+\.cpp:\d+\]\s*", "", reason(error, 250))
        raise InputError(f"Mitsuba rejects the BSDF '{bsdf.get('type')}' ({text})") from None
