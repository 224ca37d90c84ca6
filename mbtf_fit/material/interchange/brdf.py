r"""The metallic-roughness BRDF of glTF 2.0, appendix B, for many texels and pairs of directions at once.

A dielectric of diffuse base color c under a GGX lobe of reflectance F0 is blended with a metal of GGX alone:

    f = (1 - m) [(1 - F) c / π + F L] + m [c + (1 - c) S] L,    F = F0 + (1 - F0) S,    S = (1 - ω_o·h)^5

with the metallic m, the half vector h and L = D V of the height-correlated Smith masking (Heitz 2014), α the
square of the roughness. F0 = 0 stands for a surface without gloss: F is 0 at all angles. The value is the
radiance for unit irradiance of the reference plane, M = f (n·ω_i) / ω_i.z. It is affine in the base color:
:func:`affine` returns both coefficients, which all three colors share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

F64 = NDArray[np.float64]
# Least cosine to the normal of what is visible.
_LEAST_COSINE = 1e-6


@dataclass(frozen=True)
class Pairs:
    """Pairs of light and view: k of all texels, or (n, k) with those of each texel.

    Attributes
    ----------
    omega_i, omega_o, half : (k, 3) or (n, k, 3) tensors
        Unit vectors towards light and viewer, and between both.
    schlick : (k,) or (n, k) tensor
        ``(1 - ω_o·h)^5``.
    """

    omega_i: Tensor
    omega_o: Tensor
    half: Tensor
    schlick: Tensor

    @classmethod
    def of(cls, omega_i: F64, omega_o: F64, dtype: torch.dtype = torch.float64) -> Pairs:
        """Pairs of unit vectors (..., k, 3), ``z > 0``."""
        light, view = (torch.from_numpy(np.array(a)).to(dtype) for a in (omega_i, omega_o))
        half = torch.nn.functional.normalize(light + view, dim=-1)
        schlick = (1.0 - (view * half).sum(-1).clamp(0.0, 1.0)) ** 5
        return cls(light, view, half, schlick)

    def take(self, some: Tensor | slice) -> Pairs:
        """The pairs of some of the texels."""
        if self.schlick.ndim == 1:
            return self
        return Pairs(*(a[some] for a in (self.omega_i, self.omega_o, self.half, self.schlick)))


@dataclass(frozen=True)
class _Facets:
    """Cosines and the lobe of texels (n, k); the sum of masking is 1 / (2 V)."""

    light: Tensor
    view: Tensor
    peak: Tensor
    light_root: Tensor
    view_root: Tensor
    masking: Tensor
    width: Tensor
    lobe: Tensor
    visible: Tensor

    @classmethod
    def of(cls, slopes: Tensor, length: Tensor, alpha2: Tensor, pairs: Pairs) -> _Facets:
        p, q = slopes[:, :1], slopes[:, 1:]

        def cosine(omega: Tensor) -> Tensor:
            return (omega[..., 2] - p * omega[..., 0] - q * omega[..., 1]) * length

        light, view = cosine(pairs.omega_i), cosine(pairs.omega_o)
        visible = ((light > 0) & (view > 0)).to(light.dtype)
        light, view = light.clamp_min(_LEAST_COSINE), view.clamp_min(_LEAST_COSINE)
        peak = cosine(pairs.half).clamp_min(0.0)
        rest = 1.0 - alpha2
        light_root = (light * light * rest + alpha2).sqrt()
        view_root = (view * view * rest + alpha2).sqrt()
        masking = light * view_root + view * light_root
        width = 1.0 - peak * peak * rest
        lobe = alpha2 / (2.0 * math.pi * width * width * masking)
        return cls(light, view, peak, light_root, view_root, masking, width, lobe, visible)


def _shares(
    metallic: Tensor, dielectric: float, pairs: Pairs
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Factors of the lobe in the constant, of 1 and of the lobe in the factor; and Fresnel's terms of the
    dielectric and of the metal."""
    schlick = pairs.schlick
    fresnel = dielectric + (1.0 - dielectric) * schlick if dielectric > 0 else torch.zeros_like(schlick)
    constant = fresnel + metallic * (schlick - fresnel)
    diffuse = (1.0 - metallic) * ((1.0 - fresnel) / math.pi)
    return constant, diffuse, metallic * (1.0 - schlick), fresnel, schlick


def affine(
    slopes: Tensor, alpha2: Tensor, metallic: Tensor, dielectric: float, pairs: Pairs
) -> tuple[Tensor, Tensor]:
    """Value of texels at pairs of directions, in 1/sr, as ``constant + base_color · factor``.

    Parameters
    ----------
    slopes : (n, 2) tensor
        ∂z/∂x and ∂z/∂y of the shading normal.
    alpha2, metallic : (n,) tensors
        α² of GGX, and the share of metal.
    dielectric : float
        F0 of the dielectric.
    pairs : Pairs
        k pairs.

    Returns
    -------
    (constant, factor) : (n, k) tensors
        0 where the light or the viewer is below the surface.
    """
    length = (1.0 + slopes.square().sum(1, keepdim=True)).rsqrt()
    facets = _Facets.of(slopes, length, alpha2[:, None], pairs)
    constant, diffuse, metal, _, _ = _shares(metallic[:, None], dielectric, pairs)
    foreshortening = facets.visible * facets.light / pairs.omega_i[..., 2]
    lobe = facets.lobe * foreshortening
    return constant * lobe, diffuse * foreshortening + metal * lobe


def affine_derivatives(
    slopes: Tensor, alpha2: Tensor, metallic: Tensor, dielectric: float, pairs: Pairs
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:func:`affine`, and the derivatives of both by both slopes, α² and metallic.

    Returns
    -------
    constant, factor : (n, k) tensors
    by_constant, by_factor : (n, 4, k) tensors
    """
    length = (1.0 + slopes.square().sum(1, keepdim=True)).rsqrt()
    alpha2, metallic = alpha2[:, None], metallic[:, None]
    f = _Facets.of(slopes, length, alpha2, pairs)
    share, diffuse, metal, fresnel, schlick = _shares(metallic, dielectric, pairs)
    scale = f.visible / pairs.omega_i[..., 2]
    share, diffuse, metal = share * scale, diffuse * scale, metal * scale
    lobe, rest = f.lobe * f.light, 1.0 - alpha2
    # Derivatives of lobe · n·ω_i by the three cosines and by α².
    by_peak = lobe * (4.0 * rest) * f.peak / f.width
    over = lobe / f.masking
    by_light = f.lobe - over * (f.view_root + f.view * f.light * rest / f.light_root)
    by_view = -over * (f.light_root + f.view * f.light * rest / f.view_root)
    by_masking = f.light * (1.0 - f.view * f.view) / f.view_root
    by_masking = 0.5 * (by_masking + f.view * (1.0 - f.light * f.light) / f.light_root)
    by_alpha2 = lobe * (1.0 / alpha2 - 2.0 * f.peak * f.peak / f.width) - over * by_masking
    by_constant, by_factor = (torch.empty(len(lobe), 4, lobe.shape[1], dtype=lobe.dtype) for _ in range(2))
    for axis in range(2):
        tilt = slopes[:, axis, None] * length * length

        def turned(omega: Tensor, cosine: Tensor, axis: int = axis, tilt: Tensor = tilt) -> Tensor:
            return -length * omega[..., axis] - tilt * cosine

        light = turned(pairs.omega_i, f.light)
        change = by_peak * turned(pairs.half, f.peak)
        change = change + by_light * light + by_view * turned(pairs.omega_o, f.view)
        torch.mul(share, change, out=by_constant[:, axis])
        torch.add(diffuse * light, metal * change, out=by_factor[:, axis])
    torch.mul(share, by_alpha2, out=by_constant[:, 2])
    torch.mul(metal, by_alpha2, out=by_factor[:, 2])
    shown = lobe * scale
    torch.mul(schlick - fresnel, shown, out=by_constant[:, 3])
    torch.add(
        (1.0 - schlick) * shown, f.light * scale * (1.0 - fresnel), alpha=-1.0 / math.pi, out=by_factor[:, 3]
    )
    return share * lobe, diffuse * f.light + metal * lobe, by_constant, by_factor
