"""The query sensor: a Mitsuba sensor whose "pixels" are 7D queries.

Every sample is one ray through a point of the query's Gaussian footprint on the reference plane, against its
view direction. The generator's own loop asks it for rays by query number; stock ``mi.render`` drives it
through ``sample_ray``: the n-th pixel of its film (in row order) is the n-th query, with the sampler's count
of rays each. The ray's time carries the query's number, so that the light of a query can follow its rays
through stock integrators.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.sampling.query_sampler import Queries

# Query numbers travel as float32 times, exact up to here.
MAX_STOCK_QUERIES = 1 << 24


def ray_through(point: Any, omega_o: Any, unit: Any, aspect: Any, start: Any) -> Any:
    """Ray against ω_o that passes the reference plane exactly at uv `point`, wrapped into the tile.

    Parameters
    ----------
    unit : scene units per tile width; aspect : H/W; start : height in scene units at which the ray begins
    """
    wrapped = point - dr.floor(point)
    plane = mi.Point3f((wrapped.x - 0.5) * unit, (wrapped.y - 0.5) * (unit * aspect), 0.0)
    return mi.Ray3f(dr.fma(omega_o, start / omega_o.z, plane), -omega_o)


def standard_normal(xi: Any) -> Any:
    """Point of the standard normal distribution in the plane, from `xi` in [0,1)²: the inverse distribution
    function of each axis, so that well-spread numbers give well-spread points (polar coordinates tear
    neighbors apart)."""
    # Centers of cells of 2^-24: symmetric, and never at the infinite ends.
    centered = xi * 2.0 - (1.0 - 2.0**-24)
    return dr.sqrt(2.0) * dr.erfinv(centered)


class QuerySensor(mi.Sensor):
    """``mbtf_queries``: rays of a batch of queries.

    Plugin parameters: ``unit`` (scene units per tile width), ``aspect`` (H/W of the tile), ``start`` (height
    above the reference plane, in scene units, at which rays begin), a film and a sampler.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        # Opaque: other tiles use the same compiled kernels.
        self.unit = dr.opaque(mi.Float, float(props.get("unit", 32.0)))
        self.aspect = dr.opaque(mi.Float, float(props.get("aspect", 1.0)))
        self.start = dr.opaque(mi.Float, float(props.get("start", 0.01)))
        self.u = mi.Point2f(0.0)
        self.sigma = mi.Float(0.0)
        self.omega_o = mi.Vector3f(0, 0, 1)

    def set_queries(self, queries: Queries, first: int = 0) -> None:
        """Take a batch of queries (one leading axis); `first` is the number of its first query, unused
        here."""
        self.u = mi.Point2f(queries.u.T.copy())
        self.sigma = mi.Float(queries.sigma)
        self.omega_o = mi.Vector3f(queries.omega_o.T.copy())
        dr.eval(self.u, self.sigma, self.omega_o)

    def footprint(self, query: Any, xi: Any) -> Any:
        """uv of a point of the footprint of the given queries, not wrapped; `xi` in [0,1)²."""
        u = dr.gather(mi.Point2f, self.u, query)
        spread = dr.gather(mi.Float, self.sigma, query)
        offset = standard_normal(xi) * spread
        return mi.Point2f(u + mi.Vector2f(offset.x, offset.y / self.aspect))

    def ray(self, query: Any, point: Any) -> Any:
        """Ray through uv `point` of the reference plane against the view direction of the given queries."""
        omega_o = dr.gather(mi.Vector3f, self.omega_o, query)
        return ray_through(point, omega_o, self.unit, self.aspect, self.start)

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """One ray per sample; the query follows from the lane, not from the rounded film position."""
        paths = self.sampler().sample_count()
        query = dr.minimum(dr.arange(mi.UInt32, dr.width(sample2)) // paths, dr.width(self.sigma) - 1)
        ray = self.ray(query, self.footprint(query, sample3))
        ray.time = mi.Float(query)
        return ray, mi.Color3f(1.0)

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        """As :meth:`sample_ray`; a query has no differentials."""
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def to_string(self) -> str:
        """Description that Mitsuba prints."""
        return f"QuerySensor[queries = {dr.width(self.sigma)}]"
