"""GGX microfacets: distribution, masking, sampling of visible normals, Fresnel reflectance, energy tables.

Directions are local, with z the shading normal, and point away from the surface; α is the roughness of the
distribution. Sources: Walter et al. 2007, "Microfacet Models for Refraction through Rough Surfaces"
(distribution); Heitz 2014, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs"; Dupuy
and Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps"; Schlick 1994, "An Inexpensive BRDF Model
for Physically-based Rendering" (Fresnel).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import Color3f, Float, Mask, Normal3f, Point2f, UInt32, Vector3f

# Lobes of smaller α are narrower than any light kernel and are treated as mirrors.
MIRROR_ALPHA = 1.0e-5
# Nodes of the energy tables over the cosine and the roughness √α, and quadrature points of each node.
TABLE_COSINES, TABLE_ROUGHNESSES = 64, 50
TABLE_POINTS = 1 << 13
# Square root of the first row's roughness, the smallest that is not a mirror.
FIRST_ROW = MIRROR_ALPHA**0.25


def half_tangent2(wi: Vector3f, wo: Vector3f) -> Float:
    """Squared tangent of the angle between the normal and the half vector of unit directions with z > 0.

    The half vector's slope is (wi + wo).xy/(μi + μo). At grazing angles its part in the plane of incidence
    suffers from cancellation, which narrow lobes cannot afford. With the horizontal parts a of wi and b of
    -wo, |a|² - |b|² = (a+b)·(a-b) turns it into (μo - μi)/|a+b|, without cancellation.
    """
    sx, sy = wi.x + wo.x, wi.y + wo.y
    up = dr.rcp(wi.z + wo.z)
    plain = (dr.square(sx) + dr.square(sy)) * dr.square(up)
    length2 = dr.square(wi.x - wo.x) + dr.square(wi.y - wo.y)
    across = 2.0 * up * dr.fma(wi.x, sy, -wi.y * sx)
    split = (dr.square(wo.z - wi.z) + dr.square(across)) / length2
    return dr.select(length2 > 0.25, split, plain)


def distribution(tangent2: Float, alpha: Float) -> Float:
    """GGX density D(h) of microfacet normals in 1/sr, by the squared tangent of h's angle to the normal."""
    a2 = alpha * alpha
    k = (1.0 + tangent2 / a2) / (1.0 + tangent2)
    return dr.rcp(dr.pi * a2 * k * k)


def smith(cosine: Float, alpha: Float) -> Float:
    """Smith's Λ of a direction with cosine > 0 (Heitz 2014)."""
    c2 = cosine * cosine
    x = alpha * alpha * dr.maximum(1.0 - c2, 0.0) / c2
    # (√(1+x) - 1)/2 without cancellation.
    return 0.5 * x / (dr.sqrt(1.0 + x) + 1.0)


def visible_normal(wi: Vector3f, alpha: Float, xi: Point2f) -> Normal3f:
    """Sample a microfacet normal from the distribution of visible normals (Dupuy and Benyoub 2023)."""
    v = dr.normalize(mi.Vector3f(alpha * wi.x, alpha * wi.y, wi.z))
    # z of the cap's point plus v.z, the facet's z before normalization, without cancellation.
    up = (1.0 - xi.x) * (1.0 + v.z)
    z = up - v.z
    radius = dr.safe_sqrt((1.0 - z) * (1.0 + z))
    s, c = dr.sincos(dr.two_pi * xi.y)
    x, y = dr.fma(radius, c, v.x), dr.fma(radius, s, v.y)
    return dr.normalize(mi.Vector3f(alpha * x, alpha * y, dr.maximum(up, 1e-7)))


def is_mirror(roughness: Float) -> Mask:
    """Whether a lobe of roughness √α is treated as a mirror."""
    return dr.square(roughness) <= MIRROR_ALPHA


def sample_missing_energy(alpha: Float, xi: Point2f) -> Vector3f:
    """Sample a direction with the density of :func:`missing_energy_pdf`."""
    k = dr.exp(xi.x * dr.log(1.0 + 1.0 / (alpha * alpha))) - 1.0
    cosine = dr.clip(alpha * dr.sqrt(k), 1e-6, 1.0)
    sine = dr.safe_sqrt((1.0 - cosine) * (1.0 + cosine))
    s, c = dr.sincos(dr.two_pi * xi.y)
    return mi.Vector3f(sine * c, sine * s, cosine)


def missing_energy_pdf(cosine: Float, alpha: Float) -> Float:
    """Density in 1/sr, ∝ μ α²/(α² + μ²): approximately the energy that single scattering misses, which cosine
    sampling would hardly ever find where α is small."""
    return dr.inv_pi * cosine * (_peak(cosine, alpha) / _mean_peak(alpha))


def schlick(cosine: Float) -> Float:
    """Weight s = (1-μ)⁵ of the grazing reflectance: F = F0 (1 - s) + F90 s (Schlick 1994)."""
    m = dr.maximum(1.0 - cosine, 0.0)
    m2 = m * m
    return m2 * m2 * m


def grazing_reflectance(normal_reflectance: Color3f) -> Color3f:
    """F90 from F0: one, except below F0 = 2%, less than that of any dielectric in air. There it falls to
    zero with F0, so that F0 = 0 means no reflection at all."""
    return dr.minimum(1.0, 50.0 * normal_reflectance)


def _lobe_energy(cosine: Float, alpha: Float) -> tuple[Float, Float]:
    """(L, B) at nodes: the energy that single scattering misses at F = 1, and the albedo at F = s."""
    n = TABLE_POINTS
    index = dr.arange(mi.UInt32, dr.width(cosine) * n)
    node, point = index // n, index % n
    # The R2 sequence (Roberts 2018) in 32-bit integers: steps 1/g and 1/g² with the plastic number g.
    xi = mi.Point2f(mi.Float(point * 3242174889), mi.Float(point * 2447445414)) * 2.0**-32
    # Importance sampling of the few steep facets at xi.x → 1, whose energy is missing.
    rest = 1.0 - dr.minimum(xi.x, dr.one_minus_epsilon(mi.Float))
    xi.x, weight = 1.0 - rest * rest * rest, 3.0 * rest * rest
    a = dr.gather(mi.Float, alpha, node)
    mu = dr.gather(mi.Float, cosine, node)
    wi = mi.Vector3f(dr.safe_sqrt(1.0 - mu * mu), 0.0, mu)
    h = visible_normal(wi, a, xi)
    wo = 2.0 * dr.dot(wi, h) * h - wi
    si, so = smith(mu, a), smith(dr.maximum(wo.z, 1e-7), a)
    missing = dr.select(wo.z > 0, so / (1.0 + si + so), 1.0)
    grazing = (1.0 - missing) * schlick(dr.dot(wi, h))
    return dr.block_sum(weight * missing, n) / n, dr.block_sum(weight * grazing, n) / n


class EnergyTables:
    """Directional albedo of single scattering by GGX facets, by cosine μ of the view and roughness √α.

    L is the energy that a lobe of reflectance F = 1 misses, B the albedo of a lobe with F = s. The albedo of
    a lobe with F = F0 (1 - s) + F90 s is ``F0 (1 - L - B) + F90 B``.

    L peaks at μ ~ α and falls to 1e-8 away from there. The tables therefore store the smooth quotients
    ``L (α² + μ²)/α²`` and ``B/(1-L) - s(μ)``, which keeps the relative error of small values low. They are
    bilinear in ``√(log(1 + μ/α)/log(1 + 1/α))`` and in √roughness. A mirror misses no energy.
    """

    def __init__(self) -> None:
        rows, columns = TABLE_ROUGHNESSES, TABLE_COSINES
        row, column = _grid(rows, columns)
        alpha = dr.square(_roughness(row))
        cosine = dr.minimum(_cosine(mi.Float(column) / (columns - 1), alpha), 1.0)
        missing, grazing = _lobe_energy(dr.maximum(cosine, 1e-6 * alpha), alpha)
        dr.eval(missing, grazing)
        # Each entry stores two columns, so that a bilinear look-up takes two gathers.
        self._table = dr.zeros(mi.Float, 4 * rows * columns)
        nodes = (missing / _peak(cosine, alpha), grazing / (1.0 - missing) - schlick(cosine))
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
        missing, rest = self._interpolated(cosine, roughness)
        grazing = dr.block_sum((1.0 - missing) * (schlick(cosine) + rest) * measure, fine)
        missing = dr.block_sum(missing * measure, fine)
        self._average = dr.zeros(mi.Float, 2 * rows)
        index = 2 * dr.arange(mi.UInt32, rows)
        dr.scatter(self._average, missing / _mean_peak(alpha), index)
        dr.scatter(self._average, grazing, index + 1)
        dr.eval(self._average)

    def at(self, cosine: Float, roughness: Float) -> tuple[Float, Float]:
        """(L, B) at cosines in [0, 1] and roughnesses in [0, 1]."""
        missing, rest = self._interpolated(cosine, roughness)
        mirror = is_mirror(roughness)
        missing = dr.select(mirror, 0.0, missing)
        return missing, (1.0 - missing) * (schlick(cosine) + dr.select(mirror, 0.0, rest))

    def _interpolated(self, cosine: Float, roughness: Float) -> tuple[Float, Float]:
        """(L, B/(1-L) - s(μ)); mirrors use the first row."""
        alpha = dr.maximum(dr.square(roughness), MIRROR_ALPHA)
        x = dr.sqrt(dr.log(1.0 + cosine / alpha) / dr.log(1.0 + 1.0 / alpha)) * (TABLE_COSINES - 1)
        i = dr.minimum(mi.UInt32(x), TABLE_COSINES - 2)
        row, fy = _row(roughness)
        node = row * TABLE_COSINES + i
        low = dr.gather(mi.Vector4f, self._table, node)
        high = dr.gather(mi.Vector4f, self._table, node + TABLE_COSINES)
        left_right = dr.lerp(low, high, fy)
        fx = x - mi.Float(i)
        missing = dr.lerp(left_right.x, left_right.z, fx) * _peak(cosine, alpha)
        return missing, dr.lerp(left_right.y, left_right.w, fx)

    def average(self, roughness: Float) -> tuple[Float, Float]:
        """Cosine-weighted averages of L and B over the hemisphere; that of L is above 0 for mirrors too."""
        j, fy = _row(roughness)
        low, high = (dr.gather(mi.Vector2f, self._average, n) for n in (j, j + 1))
        both = dr.lerp(low, high, fy)
        return both.x * _mean_peak(dr.maximum(dr.square(roughness), MIRROR_ALPHA)), both.y


def _grid(rows: int, columns: int) -> tuple[UInt32, UInt32]:
    """Row and column of each entry of a table."""
    index = dr.arange(mi.UInt32, rows * columns)
    return index // columns, index % columns


def _roughness(row: UInt32) -> Float:
    """Roughness of a row of the tables: evenly spaced in its square root."""
    return dr.square(FIRST_ROW + mi.Float(row) * ((1.0 - FIRST_ROW) / (TABLE_ROUGHNESSES - 1)))


def _row(roughness: Float) -> tuple[UInt32, Float]:
    """(row, fraction towards the next) of a roughness."""
    y = dr.maximum(dr.sqrt(roughness) - FIRST_ROW, 0.0) * ((TABLE_ROUGHNESSES - 1) / (1.0 - FIRST_ROW))
    j = dr.minimum(mi.UInt32(y), TABLE_ROUGHNESSES - 2)
    return j, y - mi.Float(j)


def _cosine(x: Float, alpha: Float) -> Float:
    """Cosine at position x in [0, 1] of a row."""
    return alpha * (dr.exp(x * x * dr.log(1.0 + 1.0 / alpha)) - 1.0)


def _peak(cosine: Float, alpha: Float) -> Float:
    """α²/(α² + μ²), the shape of the energy that single scattering misses."""
    a2 = alpha * alpha
    return a2 / dr.fma(cosine, cosine, a2)


def _mean_peak(alpha: Float) -> Float:
    """Cosine-weighted average of :func:`_peak`."""
    a2 = alpha * alpha
    return a2 * dr.log(1.0 + 1.0 / a2)
