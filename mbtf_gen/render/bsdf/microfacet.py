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
MIRROR_ALPHA = 1.0e-5
# Nodes of the energy tables over the cosine and over roughness √α, and quadrature points of each node.
TABLE_COSINES, TABLE_ROUGHNESSES = 64, 50
TABLE_POINTS = 1 << 13
# Square root of the first row's roughness, which is the least that is no mirror.
FIRST_ROW = MIRROR_ALPHA**0.25


def half_tangent2(wi: Any, wo: Any) -> Any:
    """Squared tangent of the angle between the half vector of unit directions, z > 0 of both, and the normal.

    The half vector's slope is (wi + wo).xy/(μi + μo). Its part within the plane of incidence cancels at
    grazing angles, where narrow lobes would have no digits left; from |a|² - |b|² = (a+b)·(a-b) of the
    horizontal parts a of wi and b of -wo it is (μo - μi)/|a+b|, which keeps them.
    """
    sx, sy = wi.x + wo.x, wi.y + wo.y
    up = dr.rcp(wi.z + wo.z)
    plain = (dr.square(sx) + dr.square(sy)) * dr.square(up)
    length2 = dr.square(wi.x - wo.x) + dr.square(wi.y - wo.y)
    across = 2.0 * up * dr.fma(wi.x, sy, -wi.y * sx)
    split = (dr.square(wo.z - wi.z) + dr.square(across)) / length2
    return dr.select(length2 > 0.25, split, plain)


def distribution(tangent2: Any, alpha: Any) -> Any:
    """Density D(h) of microfacet normals in 1/sr, by the squared tangent of h's angle to the normal."""
    a2 = alpha * alpha
    k = (1.0 + tangent2 / a2) / (1.0 + tangent2)
    return dr.rcp(dr.pi * a2 * k * k)


def smith(cosine: Any, alpha: Any) -> Any:
    """Smith's Λ of a direction with cosine > 0."""
    c2 = cosine * cosine
    x = alpha * alpha * dr.maximum(1.0 - c2, 0.0) / c2
    # (√(1+x) - 1)/2 without its cancellation.
    return 0.5 * x / (dr.sqrt(1.0 + x) + 1.0)


def visible_normal(wi: Any, alpha: Any, xi: Any) -> Any:
    """Microfacet normal, drawn from those that a viewer in direction wi sees, by their projected area."""
    v = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, wi.z))
    # Height above the plane of a point of the sphere's cap, plus v: the facet's z, free of cancellation.
    up = (1.0 - xi.x) * (1.0 + v.z)
    z = up - v.z
    radius = dr.safe_sqrt((1.0 - z) * (1.0 + z))
    s, c = dr.sincos(dr.two_pi * xi.y)
    x, y = dr.fma(radius, c, v.x), dr.fma(radius, s, v.y)
    return dr.normalize(mi.Vector3f(alpha * x, alpha * y, dr.maximum(up, 1e-7)))


def is_mirror(roughness: Any) -> Any:
    """Is a lobe of this roughness √α a mirror?"""
    return dr.square(roughness) <= MIRROR_ALPHA


def lost_light(alpha: Any, xi: Any) -> Any:
    """Direction with the density of :func:`lost_light_pdf`."""
    k = dr.exp(xi.x * dr.log(1.0 + 1.0 / (alpha * alpha))) - 1.0
    cosine = dr.clip(alpha * dr.sqrt(k), 1e-6, 1.0)
    sine = dr.safe_sqrt((1.0 - cosine) * (1.0 + cosine))
    s, c = dr.sincos(dr.two_pi * xi.y)
    return mi.Vector3f(sine * c, sine * s, cosine)


def lost_light_pdf(cosine: Any, alpha: Any) -> Any:
    """Density in 1/sr of directions, ∝ μ α²/(α² + μ²): much like that of light which single scattering
    loses. Cosines alone would never find it where α is small."""
    return dr.inv_pi * cosine * (_peak(cosine, alpha) / _mean_peak(alpha))


def schlick(cosine: Any) -> Any:
    """Share s of grazing reflectance: F = F0 (1 - s) + F90 s."""
    m = dr.maximum(1.0 - cosine, 0.0)
    m2 = m * m
    return m2 * m2 * m


def grazing_reflectance(normal_reflectance: Any) -> Any:
    """F90 of F0: one, except where F0 < 2 %, less than any dielectric in air: there it falls to zero with
    F0, so that F0 = 0 means no reflection at all."""
    return dr.minimum(1.0, 50.0 * normal_reflectance)


def _lobe_energy(cosine: Any, alpha: Any) -> tuple[Any, Any]:
    """(L, B) for the nodes given: what single scattering loses of a view direction at F = 1, and what it
    reflects at F = s."""
    n = TABLE_POINTS
    index = dr.arange(mi.UInt32, dr.width(cosine) * n)
    node, point = index // n, index % n
    # The R2 sequence in integers of 32 bits: its steps are 1/g and 1/g² of the plastic number g.
    xi = mi.Point2f(mi.Float(point * 3242174889), mi.Float(point * 2447445414)) * 2.0**-32
    # The steep facets, whose light is lost, lie at xi.x → 1 and are few: they are drawn more often.
    rest = 1.0 - dr.minimum(xi.x, dr.one_minus_epsilon(mi.Float))
    xi.x, weight = 1.0 - rest * rest * rest, 3.0 * rest * rest
    a = dr.gather(mi.Float, alpha, node)
    mu = dr.gather(mi.Float, cosine, node)
    wi = mi.Vector3f(dr.safe_sqrt(1.0 - mu * mu), 0.0, mu)
    h = visible_normal(wi, a, xi)
    wo = 2.0 * dr.dot(wi, h) * h - wi
    si, so = smith(mu, a), smith(dr.maximum(wo.z, 1e-7), a)
    lost = dr.select(wo.z > 0, so / (1.0 + si + so), 1.0)
    grazing = (1.0 - lost) * schlick(dr.dot(wi, h))
    return dr.block_sum(weight * lost, n) / n, dr.block_sum(weight * grazing, n) / n


class EnergyTables:
    """What single scattering by GGX facets sends back, by cosine μ of the view and by roughness √α.

    L is what a lobe of reflectance F = 1 loses, B what one of F = s reflects: the reflectance of a lobe
    F = F0 (1 - s) + F90 s is ``F0 (1 - L - B) + F90 B``.

    All of L happens at μ ~ α, and it falls to 1e-8 away from there; the tables hold the smooth quotients
    ``L (α² + μ²)/α²`` and ``B/(1-L) - s(μ)``, bilinear in ``√(log(1 + μ/α)/log(1 + 1/α))`` and in √roughness.
    So both are exact where they are small. A mirror loses nothing.
    """

    def __init__(self) -> None:
        rows, columns = TABLE_ROUGHNESSES, TABLE_COSINES
        row, column = _grid(rows, columns)
        alpha = dr.square(_roughness(row))
        cosine = dr.minimum(_cosine(mi.Float(column) / (columns - 1), alpha), 1.0)
        lost, grazing = _lobe_energy(dr.maximum(cosine, 1e-6 * alpha), alpha)
        dr.eval(lost, grazing)
        # Two columns side by side, so that a bilinear look-up is two reads.
        self._table = dr.zeros(mi.Float, 4 * rows * columns)
        nodes = (lost / _peak(cosine, alpha), grazing / (1.0 - lost) - schlick(cosine))
        for side in (0, 1):
            place = row * columns + dr.maximum(column, side) - side
            for k, node in enumerate(nodes):
                dr.scatter(self._table, node, 4 * place + 2 * side + k, (column > 0) | (side == 0))
        dr.eval(self._table)
        # Cosine-weighted averages 2∫ X μ dμ over the same piecewise interpolation.
        fine = 16 * columns
        row, column = _grid(rows, fine)
        roughness = _roughness(row)
        alpha, t = dr.square(roughness), (mi.Float(column) + 0.5) / fine
        cosine = _cosine(t, alpha)
        measure = 4.0 * cosine * (cosine + alpha) * dr.log(1.0 + 1.0 / alpha) * t / fine
        alpha = dr.square(_roughness(dr.arange(mi.UInt32, rows)))
        lost, share = self._interpolated(cosine, roughness)
        grazing = dr.block_sum((1.0 - lost) * (schlick(cosine) + share) * measure, fine)
        lost = dr.block_sum(lost * measure, fine)
        self._average = dr.zeros(mi.Float, 2 * rows)
        index = 2 * dr.arange(mi.UInt32, rows)
        dr.scatter(self._average, lost / _mean_peak(alpha), index)
        dr.scatter(self._average, grazing, index + 1)
        dr.eval(self._average)

    def at(self, cosine: Any, roughness: Any) -> tuple[Any, Any]:
        """(L, B) at cosines in [0, 1] and roughnesses in [0, 1]."""
        lost, share = self._interpolated(cosine, roughness)
        mirror = is_mirror(roughness)
        lost = dr.select(mirror, 0.0, lost)
        return lost, (1.0 - lost) * (schlick(cosine) + dr.select(mirror, 0.0, share))

    def _interpolated(self, cosine: Any, roughness: Any) -> tuple[Any, Any]:
        """(L, B/(1-L) - s(μ)), the first row standing for all mirrors."""
        alpha = dr.maximum(dr.square(roughness), MIRROR_ALPHA)
        x = dr.sqrt(dr.log(1.0 + cosine / alpha) / dr.log(1.0 + 1.0 / alpha)) * (TABLE_COSINES - 1)
        i = dr.minimum(mi.UInt32(x), TABLE_COSINES - 2)
        row, fy = _row(roughness)
        node = row * TABLE_COSINES + i
        low = dr.gather(mi.Vector4f, self._table, node)
        high = dr.gather(mi.Vector4f, self._table, node + TABLE_COSINES)
        left_right = dr.lerp(low, high, fy)
        fx = x - mi.Float(i)
        lost = dr.lerp(left_right.x, left_right.z, fx) * _peak(cosine, alpha)
        return lost, dr.lerp(left_right.y, left_right.w, fx)

    def average(self, roughness: Any) -> tuple[Any, Any]:
        """Cosine-weighted averages of L and B over the hemisphere; L's is not 0 for mirrors either."""
        j, fy = _row(roughness)
        low, high = (dr.gather(mi.Vector2f, self._average, n) for n in (j, j + 1))
        both = dr.lerp(low, high, fy)
        return both.x * _mean_peak(dr.maximum(dr.square(roughness), MIRROR_ALPHA)), both.y


def _grid(rows: int, columns: int) -> tuple[Any, Any]:
    """Row and column of each entry of a table."""
    index = dr.arange(mi.UInt32, rows * columns)
    return index // columns, index % columns


def _roughness(row: Any) -> Any:
    """Roughness of a row of the tables: evenly spaced in its square root."""
    return dr.square(FIRST_ROW + mi.Float(row) * ((1.0 - FIRST_ROW) / (TABLE_ROUGHNESSES - 1)))


def _row(roughness: Any) -> tuple[Any, Any]:
    """(row, fraction towards the next) of a roughness."""
    y = dr.maximum(dr.sqrt(roughness) - FIRST_ROW, 0.0) * ((TABLE_ROUGHNESSES - 1) / (1.0 - FIRST_ROW))
    j = dr.minimum(mi.UInt32(y), TABLE_ROUGHNESSES - 2)
    return j, y - mi.Float(j)


def _cosine(x: Any, alpha: Any) -> Any:
    """Cosine at a place x in [0, 1] of a row."""
    return alpha * (dr.exp(x * x * dr.log(1.0 + 1.0 / alpha)) - 1.0)


def _peak(cosine: Any, alpha: Any) -> Any:
    """α²/(α² + μ²), the shape of what single scattering loses."""
    a2 = alpha * alpha
    return a2 / dr.fma(cosine, cosine, a2)


def _mean_peak(alpha: Any) -> Any:
    """Cosine-weighted average of :func:`_peak`."""
    a2 = alpha * alpha
    return a2 * dr.log(1.0 + 1.0 / a2)
