"""Facets of GGX (Walter et al. 2007) by their slopes: density, projected area, reflectance.

Matrices of slopes (n, 3) are symmetric: xx, xy, yy.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mbtf_core.data.schema import CLEARCOAT_F0


def schlick(cosine: Tensor) -> Tensor:
    """Weight of the grazing reflectance, by the cosine of incidence (Schlick 1994)."""
    return (1.0 - cosine.clamp(0.0, 1.0)) ** 5


def fresnel(f0: Tensor, half: Tensor, omega: Tensor) -> Tensor:
    """Reflectance (n, 3) of facets with normals `half`, of F0 (n, 3), towards directions (Schlick 1994)."""
    return f0 + (1.0 - f0) * schlick((omega * half).sum(1, keepdim=True))


def coat_reflectance(weight: Tensor, grazing: Tensor) -> Tensor:
    """Reflectance of a clear coat of a weight, by the weight of its grazing reflectance."""
    return weight * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * grazing)


def slope_density(half: Tensor, center: Tensor, matrix: Tensor) -> Tensor:
    """Density D(h) (n, 1) of facets per area of the reference plane.

    Parameters
    ----------
    half : (n, 3) unit vectors
    center : (n, 2) center of the slopes
    matrix : (n, 3) A (xx, xy, yy)
    """
    xx, xy, yy = matrix.split(1, 1)
    x, y = (half[:, :2] + half[:, 2:] * center).split(1, 1)
    determinant = xx * yy - xy * xy
    inside = half[:, 2:].square() + (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
    return 1.0 / (math.pi * determinant.sqrt() * inside.square())


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
