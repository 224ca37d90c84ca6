"""What the path tracer asks of a tile's geometry: implemented beside this file by a height field, traced cell
by cell, by triangles, and by fibers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from mbtf_gen.engine.types import (
    Mask,
    Normal3f,
    Point2f,
    Point3f,
    Ray3f,
    SurfaceInteraction3f,
    UInt32,
    Vector3f,
)


@dataclass
class Vertex:
    """What is stored of a vertex of a path.

    Attributes
    ----------
    p, n : position in scene units, unit normal
    s, uv : tangent and texture coordinates; None where they follow from the position
    part : number of the surface, of those of a mesh or of yarns; None for a single one
    """

    p: Point3f
    n: Normal3f
    s: Vector3f | None = None
    uv: Point2f | None = None
    part: UInt32 | None = None


class TileGeometry(Protocol):
    """A periodic surface, centered on the origin, in scene units. Rays may start anywhere; hits lie within
    one period.

    Attributes
    ----------
    open : whether rays can pass through the tile where its surface is opaque
    """

    open: bool

    def closest_hit(
        self,
        ray: Ray3f,
        active: Mask,
        max_crossings: int,
        below: Mask = False,
        holes: Any = None,
        rng: Any = None,
    ) -> tuple[SurfaceInteraction3f, UInt32, Mask, Any]:
        """First intersections of rays.

        Parameters
        ----------
        ray : rays in scene units
        active : lanes to trace
        max_crossings : tile borders that a ray may cross
        below : lanes whose ray starts below the surface
        holes : object with a method ``opacity(si)``, optional; gives the probability in [0, 1] that a hit
            stops the ray. None for opaque surfaces.
        rng : random numbers for `holes`

        Returns
        -------
        si : SurfaceInteraction3f
            Hits within the tile.
        crossings : UInt32
            Tile borders crossed.
        capped : Mask
            Lanes that reached `max_crossings`.
        rng : SobolSampler
            State of the random numbers after tracing.
        """

    def occluded(
        self,
        ray: Ray3f,
        active: Mask,
        max_crossings: int,
        below: Mask = False,
        holes: Any = None,
        rng: Any = None,
    ) -> tuple[Mask, UInt32, Mask, Any]:
        """(lanes whose ray is occluded, crossings, capped lanes, state of the random numbers). Rays that
        reached the cap count as occluded."""

    def hit_and_shadow(
        self,
        ray: Ray3f,
        active: Mask,
        shadow_ray: Ray3f,
        shadow_active: Mask,
        max_crossings: int,
        below: Mask = False,
        shadow_below: Mask = False,
    ) -> tuple[SurfaceInteraction3f, Mask, Mask, Mask]:
        """:meth:`closest_hit` of a ray and :meth:`occluded` of a shadow ray, for opaque surfaces: (hits of
        the first ray, lanes where it reached the cap, lanes whose shadow ray is occluded, lanes where that
        reached the cap)."""

    def leave(self, si: SurfaceInteraction3f, d: Vector3f) -> Ray3f:
        """Ray that starts at a surface point, offset along the normal, in direction d."""

    def vertex(self, si: SurfaceInteraction3f) -> Vertex:
        """What :meth:`interaction` needs of a hit."""

    def interaction(self, vertex: Vertex, d: Vector3f, valid: Mask) -> SurfaceInteraction3f:
        """Surface interaction at a vertex, of rays in direction d; lanes that are not `valid` have t = ∞."""
