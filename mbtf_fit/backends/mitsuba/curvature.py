"""Curvature of Mitsuba's surfaces at hits, from derivatives of their shading normals.

Mitsuba's own integrators do not ask for these derivatives, and those of a mesh are with respect to the
barycentric coordinates of a triangle, not to uv (Mitsuba 3.9). Here they follow from the shape, which is
asked again.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Float, SurfaceInteraction3f, Vector2f, Vector3f

# Largest depth of a shell in radii of curvature: sharper edges are taken to be that round.
DEEPEST = 0.8


def with_normal_partials(si: SurfaceInteraction3f, active: Any = True) -> SurfaceInteraction3f:
    """`si` with the derivatives of the shading normal by uv; 0 for instances, whose frame is unknown."""
    si = type(si)(si)
    # Mitsuba from 3.10 on has no such field.
    active = active & si.is_valid() & (getattr(si, "instance", None) == None)  # noqa: E711
    towards = si.to_world(si.wi)
    ray = mi.Ray3f(si.p + towards, -towards)
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(si.t))
    pi.t, pi.shape, pi.prim_index = 1.0, si.shape, si.prim_index
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV

    def at(u: float, v: float) -> SurfaceInteraction3f:
        pi.prim_uv = mi.Point2f(u, v)
        return si.shape.compute_surface_interaction(ray, pi, flags, active)

    mesh = si.shape.is_mesh()
    first, *others = (at(*corner) for corner in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)))
    (du1, dv1), (du2, dv2) = (other.uv - first.uv for other in others)
    dn1, dn2 = (mi.Vector3f(other.sh_frame.n - first.sh_frame.n) for other in others)
    determinant = du1 * dv2 - dv1 * du2
    inverse = dr.select(mesh & (determinant != 0.0), dr.rcp(determinant), 0.0)
    si.dn_du = dr.select(mesh, (dv2 * dn1 - dv1 * dn2) * inverse, first.dn_du)
    si.dn_dv = dr.select(mesh, (du1 * dn2 - du2 * dn1) * inverse, first.dn_dv)
    si.dn_du = dr.select(active, si.dn_du, 0.0)
    si.dn_dv = dr.select(active, si.dn_dv, 0.0)
    return si


def curvature(si: SurfaceInteraction3f, width: Float) -> tuple[Float, Float, Float]:
    """Second fundamental form (xx, xy, yy) in the shading frame, times the tile's width: positive where the
    surface is convex.

    Parameters
    ----------
    si : with derivatives of the normal
    width : of a tile
    """
    du, dv, nu, nv = (si.sh_frame.to_local(mi.Vector3f(w)) for w in (si.dp_du, si.dp_dv, si.dn_du, si.dn_dv))
    determinant = du.x * dv.y - du.y * dv.x
    inverse = dr.select(determinant != 0.0, dr.rcp(determinant), 0.0)
    scale = inverse * width
    xx = (nu.x * dv.y - nv.x * du.y) * scale
    yy = (nv.y * du.x - nu.y * dv.x) * scale
    xy = 0.5 * ((nv.x * du.x - nu.x * dv.x) + (nu.y * dv.y - nv.y * du.y)) * scale
    return xx, xy, yy


def in_axes(form: tuple[Float, Float, Float], x: Vector2f, y: Vector2f) -> Vector3f:
    """The form (xx, xy, yy) over steps along vectors of its plane."""
    xx, xy, yy = form
    ax, ay = (mi.Vector2f(xx * e.x + xy * e.y, xy * e.x + yy * e.y) for e in (x, y))
    return mi.Vector3f(dr.dot(ax, x), dr.dot(ax, y), dr.dot(ay, y))


def rounded(form: Sequence[Float], depth: Float) -> tuple[Float, Float, Float]:
    """The form (xx, xy, yy) where edges are sharper than a shell of a depth can follow."""
    xx, xy, yy = form
    largest = dr.maximum(dr.abs(xx), dr.abs(yy)) + dr.abs(xy)
    scale = dr.minimum(1.0, DEEPEST / dr.maximum(largest * depth, 1e-9))
    return scale * xx, scale * xy, scale * yy
