"""Formulas of the hints as text, for readers of a material's tensors."""

from __future__ import annotations

from mbtf_fit.models.constants import (
    ALPHA2,
    LEAST_LIGHT,
    LEAST_VARIANCE,
    LEAST_VIEW,
    LIGHT_BLUR,
    MAX_CROSSINGS,
    PLACES,
)
from mbtf_fit.surface.known import KnownSurface


def surface_formula(surface: KnownSurface, places: int) -> dict[str, str]:
    """Formulas of the hints in terms of the tensors ``surface.*``."""
    offsets, finer = PLACES[places]
    named = ", ".join(f"({x:.9g}, {y:.9g})" for x, y in offsets)
    channels = "sx, sy (slopes), q (mean of sx^2 + sy^2), b (base color, RGB)"
    value = "b / pi"
    lobe = {}
    if surface.glossy:
        channels += ", r (alpha^2), k (metallic)"
        value = "(1 - k) * b / pi + F * D / (2 * (g(ci) + g(co)) * ci * co)"
        low, high = ALPHA2
        lobe = {
            "alpha2": f"clamp(r + max(0, q - sx^2 - sy^2) + surface.light_width^2, {low:g}, {high:g})",
            "f0": "(1 - k) * surface.dielectric + k * b",
            "ci, co": f"max({LEAST_LIGHT:g}, dot(n, omega_i)), max({LEAST_VIEW:g}, dot(n, omega_o))",
            "h": "normalize(omega_i + omega_o)",
            "D": "alpha2 / (pi * (max(0, dot(n, h))^2 * (alpha2 - 1) + 1)^2)",
            "g(c)": "sqrt(1 + alpha2 * (1 / c^2 - 1))",
            "F": "f0 + (1 - f0) * (1 - dot(omega_o, h))^5",
        }
    return {
        "rotate(a, w)": "(w.x - a.x * s, w.y - a.y * s, a.z * w.z + t), where t = a.x * w.x + a.y * w.y, "
        "s = w.z + t / (1 + a.z)",
        "places": "x_j = u + 2^-l / 2 * (o_j.x * (-a.y, a.x) + o_j.y * a) / (1, aspect), a = "
        f"normalize(omega_o.x, omega_o.y), (1, 0) of a vertical omega_o; o_j: {named}; maps and horizons "
        f"are read at the level l + {finer:g}, at most that of their last texture; z, e, n.x, n.y and core "
        "are means over the places",
        "z": "height of the first point, from above, of the line x_j + t * omega_o that lies on the "
        "surface: heights surface.heights at texel centers, linear on the two triangles of each cell, which "
        "meet where x + y = 1, x along u and y along v from 0 to 1; at least that of the point where the "
        "line leaves the grid, whose periods begin at the first texel's center, for the "
        f"{MAX_CROSSINGS + 1}th time",
        "hit": "x_j + z / omega_o.z * (omega_o.x, omega_o.y) / (1, aspect)",
        "maps": f"the textures surface.maps.0 ... k+1 (levels 0 to k+1) at hit, blended by level: {channels}",
        "n": "normalize(-sx, -sy, 1); in rotate: n.z = sqrt(max(0, 1 - n.x^2 - n.y^2)) of the means",
        "horizon": "m, q = the textures surface.horizons.0 ... k at hit, blended by level, at the azimuth of "
        "omega_i (0 of a vertical one): the first half of the channels are m, the second half q, of the "
        "azimuths 2 pi j / count from +x towards +y, linear between them",
        "V": f"(1 + erf((asin(omega_i.z) - m) / sqrt(2 * max({LEAST_VARIANCE:g}, max(0, q - m^2) + "
        f"({LIGHT_BLUR:g} * surface.light_width)^2)))) / 2",
        "e": "V * max(0, dot(n, omega_i)) / omega_i.z",
        **lobe,
        "core": f"e * ({value})",
    }
