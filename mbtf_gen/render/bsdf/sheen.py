r"""Sheen: a layer of upright fibers that is bright at grazing views, such as velvet, dust or peach skin.

It is a microfacet model. The normals h have the density of Estevez and Kulla 2017 ("Production Friendly
Microfacet Sheen BRDF"), ``D(h) = (2+n)/(2π) sinⁿθ`` with n = 1/α and α = roughness². Masking and shadowing
follow Smith's theory, which for any distribution needs only the projected area that a direction sees,

    q(ω) = ∫ D(h) (ω·h)⁺ dh,    f = F·D(h) / (4 (q(ωi) μo + q(ωo) μi - μi μo)),

which is the height-correlated G2 of Heitz 2014 written with q = μ (1+Λ). So the layer conserves energy
without fitted corrections. q and the directional albedo E at F = 1 are integrated once per process, in double
precision.
"""

from __future__ import annotations

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mbtf_gen.engine.types import Float, Vector3f

F64 = NDArray[np.float64]

# Smaller roughnesses are clamped: fibers would be so upright that they reflect within one plane alone.
SMALLEST_ROUGHNESS = 0.07
# Nodes of the tables over the cosine and over the logarithm of roughness.
TABLE_COSINES, TABLE_ROUGHNESSES = 64, 32
# Points of the quadratures: over fibers, over polar angles, and over half of the azimuth.
_FIBERS, _POLAR, _AZIMUTH = 200, 64, 48
_LOG_RANGE = float(-np.log(SMALLEST_ROUGHNESS))


def fiber_density(sine2: Float, roughness: Float) -> Float:
    """D(h) in 1/sr for the squared sine of h's polar angle."""
    n = dr.rcp(dr.square(dr.maximum(roughness, SMALLEST_ROUGHNESS)))
    return (2.0 + n) * (0.5 * dr.inv_pi) * dr.power(dr.maximum(sine2, 1e-12), 0.5 * n)


def sheen_value(wi: Vector3f, wo: Vector3f, roughness: Float, q_i: Float, q_o: Float) -> Float:
    """Sheen lobe times the cosine of the other direction, f·μo, at F = 1."""
    h = wi + wo
    sine2 = (dr.square(h.x) + dr.square(h.y)) / dr.squared_norm(h)
    below = dr.fma(q_i, wo.z, q_o * wi.z) - wi.z * wo.z
    return 0.25 * wo.z * fiber_density(sine2, roughness) / dr.maximum(below, 1e-12)


class SheenTables:
    """q and E by cosine μ and roughness, bilinear in asin ∜μ, which resolves both ends, and log roughness.

    The table stores (q·roughness, E), which hardly vary with roughness.
    """

    def __init__(self) -> None:
        x = np.linspace(0.0, 1.0, TABLE_COSINES)
        cosine = np.sin(0.5 * np.pi * x) ** 4
        nodes = np.empty((TABLE_ROUGHNESSES, TABLE_COSINES, 2), np.float32)
        for row, step in enumerate(np.linspace(0.0, 1.0, TABLE_ROUGHNESSES)):
            roughness = float(np.exp((step - 1.0) * _LOG_RANGE))
            nodes[row, :, 0] = roughness * projected_area(cosine, roughness)
            nodes[row, :, 1] = directional_albedo(cosine, roughness)
        self._table = mi.Float(nodes.ravel())

    def at(self, cosine: Float, roughness: Float) -> tuple[Float, Float]:
        """(q, E) at cosines in [0, 1] and roughnesses in [0, 1]."""
        rough = dr.maximum(roughness, SMALLEST_ROUGHNESS)
        x = dr.asin(dr.sqrt(dr.sqrt(dr.clip(cosine, 0.0, 1.0)))) * ((TABLE_COSINES - 1) * 2.0 * dr.inv_pi)
        y = (1.0 + dr.log(rough) / _LOG_RANGE) * (TABLE_ROUGHNESSES - 1)
        i = dr.minimum(mi.UInt32(x), TABLE_COSINES - 2)
        j = dr.minimum(mi.UInt32(dr.maximum(y, 0.0)), TABLE_ROUGHNESSES - 2)
        node = j * TABLE_COSINES + i
        fx, fy = x - mi.Float(i), y - mi.Float(j)
        rows = [
            dr.lerp(
                dr.gather(mi.Vector2f, self._table, node + k),
                dr.gather(mi.Vector2f, self._table, node + k + 1),
                fx,
            )
            for k in (0, TABLE_COSINES)
        ]
        both = dr.lerp(rows[0], rows[1], fy)
        return both.x / rough, both.y


@cache
def _gauss(points: int) -> tuple[F64, F64]:
    """Nodes and weights of the Gauss-Legendre rule over [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(points)
    return 0.5 * (x + 1.0), 0.5 * w


def projected_area(cosine: F64, roughness: float) -> F64:
    """q of directions; the azimuth of h is integrated in closed form."""
    x, w = _gauss(_FIBERS)
    theta, weight = 0.5 * np.pi * x, 0.5 * np.pi * w
    n = 1.0 / roughness**2
    density = (2.0 + n) / (2.0 * np.pi) * np.sin(theta) ** (n + 1.0)
    a = np.multiply.outer(cosine, np.cos(theta))
    b = np.multiply.outer(np.sqrt((1.0 - cosine) * (1.0 + cosine)), np.sin(theta))
    # ∫ max(0, a + b cos φ) dφ over the circle.
    turn = np.arccos(np.clip(-a / np.maximum(b, 1e-300), -1.0, 1.0))
    area: F64 = (2.0 * (a * turn + b * np.sin(turn))) @ (density * weight)
    return area


def directional_albedo(cosine: F64, roughness: float) -> F64:
    """E of directions: ∫ f μo dωo at F = 1."""
    # Substitution μo = t² resolves grazing directions, which reflect most.
    t, w = _gauss(_POLAR)
    mu, measure = t**2, 2.0 * t**3 * w
    x, v = _gauss(_AZIMUTH)
    phi, turn = np.pi * x, 2.0 * np.pi * v
    n = 1.0 / roughness**2
    q_i, q_o = projected_area(cosine, roughness)[:, None, None], projected_area(mu, roughness)[:, None]
    mu_i, mu_o = cosine[:, None, None], mu[:, None]
    s = np.sqrt((1.0 - mu_i**2) * (1.0 - mu_o**2)) * np.cos(phi)
    up = mu_i + mu_o
    # |wi + wo|² = 2 + 2 wi·wo; the half vector's sine follows from it and from z.
    length2 = 2.0 + 2.0 * (mu_i * mu_o + s)
    sine2 = np.clip(1.0 - up**2 / np.maximum(length2, 1e-300), 0.0, 1.0)
    density = (2.0 + n) / (2.0 * np.pi) * sine2 ** (0.5 * n)
    value = density / (4.0 * (q_i * mu_o + q_o * mu_i - mu_i * mu_o))
    albedo: F64 = np.asarray((value @ turn) @ measure)
    return albedo
