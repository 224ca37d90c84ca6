"""The query sensor: a Mitsuba sensor whose "pixels" are 7D queries.

Every sample is one ray through a point of the query's Gaussian footprint on the reference plane, against its view
direction. The generator's own loop asks it for rays by query number; stock ``mi.render`` drives it through
``sample_ray``: the n-th pixel of its film (in row order) is the n-th query, with the sampler's count of rays each.
The ray's time carries the query's number, so that the light of a query can follow its rays through stock integrators.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from .queries import Queries

# Query numbers travel as float32 times, exact up to here.
MAX_STOCK_QUERIES = 1 << 24


class QuerySensor(mi.Sensor):  # type: ignore[misc]
    """``mbtf_queries``: rays of a batch of queries.

    Plugin parameters: ``unit`` (scene units per tile width), ``aspect`` (H/W of the tile), ``start`` (height above the
    reference plane, in scene units, at which rays begin), a film and a sampler.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.unit = float(props.get("unit", 32.0))
        self.aspect = float(props.get("aspect", 1.0))
        self.start = float(props.get("start", 0.01))
        self.u = mi.Point2f(0.0)
        self.sigma = mi.Float(0.0)
        self.omega_o = mi.Vector3f(0, 0, 1)

    def set_queries(self, queries: Queries) -> None:
        """Take a batch of queries (one leading axis)."""
        self.u = mi.Point2f(queries.u.T.copy())
        self.sigma = mi.Float(queries.sigma)
        self.omega_o = mi.Vector3f(queries.omega_o.T.copy())

    def footprint(self, query: Any, xi: Any) -> Any:
        """uv, in [0,1)², of a point of the footprint of the given queries; `xi` in [0,1)²."""
        u = dr.gather(mi.Point2f, self.u, query)
        spread = dr.gather(mi.Float, self.sigma, query)
        offset = mi.warp.square_to_std_normal(xi) * spread
        point = u + mi.Vector2f(offset.x, offset.y / self.aspect)
        return mi.Point2f(point - dr.floor(point))

    def ray(self, query: Any, point: Any) -> Any:
        """Ray through uv `point` of the reference plane against the view direction of the given queries.

        It starts above the plane, back along the view direction, so that it passes the plane exactly at the point.
        """
        omega_o = dr.gather(mi.Vector3f, self.omega_o, query)
        plane = mi.Point3f((point.x - 0.5) * self.unit, (point.y - 0.5) * (self.unit * self.aspect), 0.0)
        return mi.Ray3f(dr.fma(omega_o, self.start / omega_o.z, plane), -omega_o)

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
