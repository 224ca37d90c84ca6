"""GGX microfacets: distribution, masking, sampling of visible normals, Fresnel reflectance, energy tables.

Directions are local, z the shading normal, pointing away from the surface; α is the roughness of the
distribution. Walter et al. 2007 (distribution), Heitz 2014 (height-correlated masking and shadowing), Dupuy
and Benyoub 2023 (visible normals from spherical caps), Schlick 1994 (Fresnel).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

# A lobe of a smaller α is narrower than any light kernel: the surface is a mirror there.
MIRROR_ALPHA = 1.0e-4
# Nodes of the energy tables over √cosine and over roughness √α, and quadrature points of each node.
TABLE_COSINES, TABLE_ROUGHNESSES = 96, 65
TABLE_POINTS = 1 << 13


def distribution(h: Any, alpha: Any) -> Any:
    """Density D(h) of microfacet normals in 1/sr, for h with z > 0."""
    a2 = alpha * alpha
    # From the sine: a narrow lobe has no cosines left in single precision.
    k = (h.x * h.x + h.y * h.y) / a2 + h.z * h.z
    return dr.rcp(dr.pi * a2 * k * k)


def smith(cosine: Any, alpha: Any) -> Any:
    """Smith's Λ of a direction with cosine > 0."""
    c2 = cosine * cosine
    tangent2 = dr.maximum(1.0 - c2, 0.0) / c2
    return 0.5 * (dr.sqrt(1.0 + alpha * alpha * tangent2) - 1.0)


def visible_normal(wi: Any, alpha: Any, xi: Any) -> Any:
    """Microfacet normal, drawn from those that a viewer in direction wi sees, by their projected area."""
    v = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, wi.z))
    z = dr.fma(1.0 - xi.x, 1.0 + v.z, -v.z)
    s, c = dr.sincos(dr.two_pi * xi.y)
    radius = dr.safe_sqrt((1.0 - z) * (1.0 + z))
    h = mi.Vector3f(radius * c, radius * s, z) + v
    return dr.normalize(mi.Vector3f(alpha * h.x, alpha * h.y, dr.maximum(h.z, 1e-7)))


def schlick(cosine: Any) -> Any:
    """Share s of grazing reflectance: F = F0 (1 - s) + F90 s."""
    m = dr.maximum(1.0 - cosine, 0.0)
    m2 = m * m
    return m2 * m2 * m


def grazing_reflectance(normal_reflectance: Any) -> Any:
    """F90 of F0: one, except where F0 < 2 %, less than any dielectric in air: there it falls to zero with
    F0, so that F0 = 0 means no reflection at all."""
    return dr.minimum(1.0, 50.0 * normal_reflectance)


def _reflected_shares(cosine: Any, roughness: Any) -> tuple[Any, Any]:
    """(A, B) for the nodes given: what the facets send back of a view direction, for F = 1 and for F = s."""
    count = dr.width(cosine)
    n = TABLE_POINTS
    index = dr.arange(mi.UInt32, count * n)
    node, point = index // n, index % n
    # The R2 sequence in integers of 32 bits: its steps are 1/g and 1/g² of the plastic number g.
    xi = mi.Point2f(mi.Float(point * 3242174889), mi.Float(point * 2447445414)) * 2.0**-32
    xi = dr.minimum(xi, dr.one_minus_epsilon(mi.Float))
    alpha = dr.maximum(dr.square(dr.gather(mi.Float, roughness, node)), MIRROR_ALPHA)
    mu = dr.gather(mi.Float, cosine, node)
    wi = mi.Vector3f(dr.safe_sqrt(1.0 - mu * mu), 0.0, mu)
    h = visible_normal(wi, alpha, xi)
    wo = 2.0 * dr.dot(wi, h) * h - wi
    si, so = smith(wi.z, alpha), smith(dr.maximum(wo.z, 1e-7), alpha)
    share = dr.select(wo.z > 0, (1.0 + si) / (1.0 + si + so), 0.0)
    grazing = share * schlick(dr.dot(wi, h))
    return dr.block_sum(share, n) / n, dr.block_sum(grazing, n) / n


class EnergyTables:
    """What single scattering by GGX facets sends back, by cosine of the view and by roughness.

    The reflectance of a lobe F = F0 (1 - s) + F90 s is ``F0 (A - B) + F90 B``; ``1 - A`` is what single
    scattering loses. Bilinear in √cosine and in roughness √α.
    """

    def __init__(self) -> None:
        rows, columns = TABLE_ROUGHNESSES, TABLE_COSINES
        index = dr.arange(mi.UInt32, rows * columns)
        root = mi.Float(index % columns) / (columns - 1)
        roughness = mi.Float(index // columns) / (rows - 1)
        a, b = _reflected_shares(dr.maximum(root * root, 1e-5), roughness)
        self._table = dr.zeros(mi.Float, 2 * rows * columns)
        dr.scatter(self._table, a, 2 * index)
        dr.scatter(self._table, b, 2 * index + 1)
        dr.eval(self._table)
        # Cosine-weighted averages 2∫ X μ dμ over the same piecewise interpolation, μ = t², dμ = 2t dt.
        fine = 16 * columns
        point = dr.arange(mi.UInt32, rows * fine)
        t = (mi.Float(point % fine) + 0.5) / fine
        pair = self.at(t * t, mi.Float(point // fine) / (rows - 1))
        self._average = dr.zeros(mi.Float, 2 * rows)
        row = dr.arange(mi.UInt32, rows)
        for k in range(2):
            dr.scatter(self._average, dr.block_sum(pair[k] * t * t * t, fine) * (4.0 / fine), 2 * row + k)
        dr.eval(self._average)

    def at(self, cosine: Any, roughness: Any) -> tuple[Any, Any]:
        """(A, B) at cosines in [0, 1] and roughnesses in [0, 1]."""
        x = dr.safe_sqrt(cosine) * (TABLE_COSINES - 1)
        y = roughness * (TABLE_ROUGHNESSES - 1)
        i = dr.minimum(mi.UInt32(x), TABLE_COSINES - 2)
        j = dr.minimum(mi.UInt32(y), TABLE_ROUGHNESSES - 2)
        fx, fy = x - mi.Float(i), y - mi.Float(j)
        low = j * TABLE_COSINES + i

        def pair(node: Any) -> Any:
            return dr.gather(mi.Vector2f, self._table, node)

        upper = dr.lerp(pair(low), pair(low + 1), fx)
        lower = dr.lerp(pair(low + TABLE_COSINES), pair(low + TABLE_COSINES + 1), fx)
        both = dr.lerp(upper, lower, fy)
        return both.x, both.y

    def average(self, roughness: Any) -> tuple[Any, Any]:
        """Cosine-weighted averages of A and B over the hemisphere."""
        y = roughness * (TABLE_ROUGHNESSES - 1)
        j = dr.minimum(mi.UInt32(y), TABLE_ROUGHNESSES - 2)
        both = dr.lerp(
            dr.gather(mi.Vector2f, self._average, j),
            dr.gather(mi.Vector2f, self._average, j + 1),
            y - mi.Float(j),
        )
        return both.x, both.y
