"""Surface interactions on the height field, as Mitsuba's BSDFs and textures expect them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mbtf_gen.render.types import Float, Mask, Normal3f, Point3f, SurfaceInteraction3f, Vector3f


def interaction(
    p: Point3f, n: Normal3f, d: Vector3f, size: tuple[Float, Float], valid: Mask
) -> SurfaceInteraction3f:
    """Surface interaction at points of a height field.

    Parameters
    ----------
    p, n : Point3f, Normal3f
        Position in scene units from the tile's center, and unit normal with z > 0.
    d : Vector3f
        Direction of the ray.
    size : tuple of two Float
        (x, y) lengths of the tile in scene units.
    valid : Mask
        Lanes with a hit. They get t = 0, the others t = ∞; distances are not needed.
    """
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.t = dr.select(valid, mi.Float(0.0), dr.inf)
    si.p = p
    si.n = n
    # Mitsuba's bitmaps have row 0 at v = 0, ours at v → 1.
    si.uv = mi.Point2f(p.x / size[0] + 0.5, 0.5 - p.y / size[1])
    si.dp_du = size[0] * mi.Vector3f(1.0, 0.0, -n.x / n.z)
    si.dp_dv = -size[1] * mi.Vector3f(0.0, 1.0, -n.y / n.z)
    s = dr.normalize(si.dp_du)
    si.sh_frame = mi.Frame3f(s, dr.cross(n, s), n)
    si.wi = si.to_local(-d)
    return si
