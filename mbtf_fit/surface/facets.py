"""Facets of GGX (Walter et al. 2007) by their slopes: density, projected area, reflectance.

Matrices of slopes (n, 3) are symmetric: xx, xy, yy.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_fit.ops.constants import ALBEDO_SPREAD, VOIGT_SCALE, VOIGT_WIDENING


def schlick(cosine: Tensor) -> Tensor:
    """Weight of the grazing reflectance, by the cosine of incidence (Schlick 1994)."""
    return (1.0 - cosine.clamp(0.0, 1.0)) ** 5


def fresnel(f0: Tensor, half: Tensor, omega: Tensor) -> Tensor:
    """Reflectance (n, 3) of facets with normals `half`, of F0 (n, 3), towards directions (Schlick 1994)."""
    return f0 + (1.0 - f0) * schlick((omega * half).sum(1, keepdim=True))


def coat_reflectance(weight: Tensor, grazing: Tensor) -> Tensor:
    """Reflectance of a clear coat of a weight, by the weight of its grazing reflectance."""
    return weight * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * grazing)


def grazing_albedo(alpha2: Tensor, cosine: Tensor) -> Tensor:
    """(R6) Weight of the grazing reflectance in the albedo of a lobe of α², by the direction's cosine."""
    rough, cosine2 = _added(alpha2), cosine.square()
    return schlick((cosine2 + rough * (1.0 - cosine2)).sqrt())


def mean_grazing_albedo(alpha2: Tensor) -> Tensor:
    """(R9) Mean of :func:`grazing_albedo`, weighted by the cosine."""
    rough = _added(alpha2)
    t = 1.0 - rough.sqrt()
    return 2.0 * t**6 * (1.0 / 6.0 - t / 7.0) / (1.0 - rough)


def _added(alpha2: Tensor) -> Tensor:
    """Squared cosine that facets add at grazing angles."""
    return alpha2 / (ALBEDO_SPREAD[0] + ALBEDO_SPREAD[1] * alpha2.sqrt())


def own_shadowing(alpha2: Tensor, light: Tensor, view: Tensor) -> Tensor:
    """(R10) Share of the facets of α² in the light, of those that the viewer sees, by both cosines."""
    a, b = ((alpha2 + (1.0 - alpha2) * x * x).sqrt() for x in (light, view))
    return light * (view + b) / (light * b + view * a)


def light_widening(omega_i: Tensor, omega_o: Tensor, width: float) -> Tensor:
    """Covariance W (n, 3) of the slopes of half vectors, by the light's RMS angle per axis in radians."""
    both = omega_i + omega_o
    s = -both[:, :2] / both[:, 2:]
    (x, y), (p, q) = s.split(1, 1), (omega_i[:, :2] + omega_i[:, 2:] * s).split(1, 1)
    turned = torch.cat([1.0 + x * x - p * p, x * y - p * q, 1.0 + y * y - q * q], 1)
    return (width / both[:, 2:]).square() * turned


def slope_density(half: Tensor, center: Tensor, matrix: Tensor, widening: Tensor, least: Tensor) -> Tensor:
    """Density D(h) (n, 1) of facets per area of the reference plane, averaged over the light.

    Parameters
    ----------
    half : (n, 3) unit vectors
    center : (n, 2) center of the slopes
    matrix : (n, 3) A (xx, xy, yy)
    widening : (n, 3) W of :func:`light_widening`
    least : (n, 1) smallest eigenvalue that A may have
    """
    x, y = (half[:, :2] + half[:, 2:] * center).split(1, 1)
    up2 = half[:, 2:].square()

    def inverse(matrix: Tensor) -> tuple[Tensor, Tensor]:
        """Root of the determinant, and gᵀ B⁻¹ g."""
        xx, xy, yy = matrix.split(1, 1)
        determinant = torch.maximum(xx * yy - xy * xy, 0.25 * least * (xx + yy))
        square = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
        return determinant.sqrt(), square.clamp_min(0.0)

    xx, xy, yy = widening.split(1, 1)
    light = (xx * yy - xy * xy).clamp_min(1e-20).sqrt()
    own, _ = inverse(matrix)
    wide, distance = inverse(matrix + VOIGT_WIDENING * widening)
    share = own / wide
    narrow, deviations = inverse(widening + (VOIGT_SCALE + 0.5 / (own / light + VOIGT_SCALE)) * matrix)
    gaussian = torch.exp(-0.5 * deviations / up2) / (2.0 * narrow * up2.square())
    return (share / (wide * (up2 + distance).square()) + (1.0 - share) * gaussian) / math.pi


def projections(omega: Tensor, center: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """(R4) Both terms (n, 1) of :func:`shown`: p, and the root of p² + ω_xyᵀ A ω_xy."""
    x, y, z = omega.split(1, 1)
    p = z - (center * omega[:, :2]).sum(1, keepdim=True)
    square = torch.cat([x * x, 2.0 * x * y, y * y], 1)
    return p, (p * p + (matrix * square).sum(1, keepdim=True)).clamp_min(1e-20).sqrt()


def shown(omega: Tensor, center: Tensor, matrix: Tensor) -> Tensor:
    """(R4) Area (n, 1) that facets show to directions, per area of the reference plane."""
    p, root = projections(omega, center, matrix)
    return 0.5 * (p + root)


def own_facets(alpha2: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """Center (n, 2) and matrix (n, 3), in slopes of the plane, of facets of α² (n, 1) about a center."""
    length2 = center.square().sum(1, keepdim=True)
    scale = 1.0 + alpha2 * length2
    middle, rho = (1.0 - alpha2) / scale * center, alpha2 * (1.0 + length2) / scale
    (x, y), (p, q) = center.split(1, 1), middle.split(1, 1)
    return middle, rho * torch.cat([1.0 + p * x, p * y, 1.0 + q * y], 1)


def doubled_scatter(center: Tensor, moments: Tensor) -> Tensor:
    """2C (n, 3) of centers and moments."""
    x, y = center.split(1, 1)
    xx, xy, yy = (moments - torch.cat([x * x, x * y, y * y], 1)).split(1, 1)
    xx, yy = xx.clamp_min(0.0), yy.clamp_min(0.0)
    most = (xx * yy).sqrt()
    return 2.0 * torch.cat([xx, xy.clamp(-most, most), yy], 1)
