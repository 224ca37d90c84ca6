"""What rays met, as Mitsuba's BSDFs and textures ask about it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def interaction(p: Any, n: Any, d: Any, size: tuple[Any, Any], valid: Any) -> Any:
    """Surface interaction of places on a height field.

    Parameters
    ----------
    p, n : position in scene units from the tile's center, unit normal with z > 0
    d : direction of the rays
    size : (x, y) lengths of the tile in scene units
    valid : lanes that met something; of `t` no more is told than that
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
