"""What is known of fibers below footprints, and directions about them (:mod:`mbtf_fit.ops.fibers`).

Symmetric matrices (n, 6) are xx, xy, xz, yy, yz, zz.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mbtf_fit.ops.fibers import FiberFrame

if TYPE_CHECKING:
    from mbtf_core.data.geometry import Geometry

# Rows and columns of the numbers of a symmetric matrix.
_ROWS, _COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


def fiber_maps(geometry: Geometry) -> Tensor | None:
    """Maps (h, w, 7) of the fibers of a geometry, before any filter; None for a surface without."""
    if geometry.tangent_moments is None or geometry.longitudinal_variance is None:
        return None
    return torch.from_numpy(
        np.concatenate([geometry.tangent_moments, geometry.longitudinal_variance[..., None]], -1)
    )


def fiber_frame(op: FiberFrame, maps: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
    """The operation (n, 6) at surface points with maps (n, 7)."""
    moments = maps[:, :6]
    coverage = _trace(moments).clamp_min(0.0)
    covered = coverage.clamp_min(op.least_tangents)
    mean = moments / covered
    axis = mean
    for _ in range(3):
        axis = _squared(axis)
    half = omega_i + omega_o
    light, view, both = (
        _form(axis, *w) for w in ((omega_i, omega_i), (omega_o, omega_o), (omega_i, omega_o))
    )
    light, view = light.clamp(0.0, 1.0), view.clamp(0.0, 1.0)
    cosines = ((1.0 - light) * (1.0 - view)).sqrt().clamp_min(op.least_cosine)
    azimuth = (((omega_i * omega_o).sum(1, keepdim=True) - both) / cosines).clamp(-1.0, 1.0)
    off = light + view + 2.0 * both
    along = _trace(_product(mean, axis))
    spread = (_form(mean, half, half) - off * along).clamp_min(0.0)
    variance = (maps[:, 6:] / covered + spread).clamp_min(op.least_variance)
    lobe = torch.exp(-0.5 * off / variance) / (2.0 * math.pi * variance).sqrt()
    return torch.cat([coverage * lobe, azimuth, light, view, both, coverage], 1)


def _trace(m: Tensor) -> Tensor:
    return m[:, 0:1] + m[:, 3:4] + m[:, 5:6]


def _form(m: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """aᵀ M b (n, 1)."""
    products = a[:, _ROWS] * b[:, _COLUMNS]
    mirrored = a[:, _COLUMNS] * b[:, _ROWS]
    off = m.new_tensor([0.0, 1.0, 1.0, 0.0, 1.0, 0.0])
    return (m * (products + off * mirrored)).sum(1, keepdim=True)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Product of matrices that commute."""
    xx, xy, xz, yy, yz, zz = a.unbind(1)
    p, q, r, s, t, u = b.unbind(1)
    return torch.stack(
        [
            xx * p + xy * q + xz * r,
            xx * q + xy * s + xz * t,
            xx * r + xy * t + xz * u,
            xy * q + yy * s + yz * t,
            xy * r + yy * t + yz * u,
            xz * r + yz * t + zz * u,
        ],
        1,
    )


def _squared(m: Tensor) -> Tensor:
    """M² over its trace."""
    square = _product(m, m)
    return square / _trace(square).clamp_min(1e-12)
