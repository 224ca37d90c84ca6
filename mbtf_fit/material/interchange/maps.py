"""Maps of a material at one level, for the metallic-roughness model that renderers share.

Models that trace a surface know its filtered maps (:mod:`mbtf_fit.surface.known`): slopes, the mean of their
squares, base color, α², metallic. The variance of the slopes within a texel widens the lobe (LEAN mapping,
Olano and Baker 2010). Maps of other models are fitted to their values
(:mod:`~mbtf_fit.material.interchange.lobes`). Maps show no shadows, interreflection or parallax of their own.
Their base color is therefore scaled (:mod:`~mbtf_fit.material.interchange.agreement`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mbtf_core.errors import UsageError
from mbtf_fit.material.interchange.brdf import Pairs, affine
from mbtf_fit.material.material import Material
from mbtf_fit.ops.constants import DIELECTRIC, GLOSSY_CHANNELS, HEIGHTS, MAPS

F64 = NDArray[np.float64]
# Least roughness: smaller lobes are narrower than those that data are made with.
_LEAST_ALPHA2 = 1e-4


@dataclass(frozen=True)
class Maps:
    """Maps (rows, columns, ...) of one level, row 0 at ``v → 1``.

    Attributes
    ----------
    level : int
    aspect : float
        Height of the tile over its width.
    base_color : (rows, columns, 3) array
        Linear, in [0, 1].
    slopes : (rows, columns, 2) array
        ∂z/∂x and ∂z/∂y.
    roughness, metallic, opacity : (rows, columns) arrays
        In [0, 1]; opacity towards the normal.
    dielectric : float
        F0 of the dielectric; 0 for a surface without gloss.
    heights : (H, W) array or None
        In tile widths, at most 0, on the grid that rays are traced to; None of a model that knows no surface.
    """

    level: int
    aspect: float
    base_color: F64
    slopes: F64
    roughness: F64
    metallic: F64
    opacity: F64
    dielectric: float
    heights: F64 | None

    @property
    def normals(self) -> F64:
        """Unit normals (rows, columns, 3): x along u, y along v."""
        n = np.concatenate([-self.slopes, np.ones((*self.slopes.shape[:2], 1))], -1)
        out: F64 = n / np.linalg.norm(n, axis=-1, keepdims=True)
        return out


def knows_surface(material: Material) -> bool:
    """Whether the model traces a surface, whose maps it has."""
    return HEIGHTS in material.model.weights()


def level_of(material: Material, level: int | None = None) -> int:
    """A level of the material; by default its finest.

    Raises
    ------
    UsageError
        The material has no such level.
    """
    finest = material.lattice.finest
    level = finest if level is None else level
    if not 0 <= level <= finest:
        raise UsageError(f"the material has the levels 0 to {finest}", where="--level")
    return level


def opacity_of(material: Material, level: int) -> F64:
    """Opacity (rows, columns) towards the normal of the texels of a level."""
    if material.transmittance is None:
        return np.ones(material.lattice.shape(level))
    through = np.clip(material.transmittance.levels[level][..., 0], 0.0, 1.0)
    return 1.0 - through.astype(np.float64)


def surface_maps(material: Material, level: int) -> Maps:
    """Maps that a material knows of its surface.

    Parameters
    ----------
    material : Material
        With a surface: :func:`knows_surface`.
    level : int

    Returns
    -------
    Maps
    """
    weights = material.model.weights()
    maps = weights[f"{MAPS}.{level}"].cpu().double().numpy()
    slopes, square, base = maps[..., :2], maps[..., 2], maps[..., 3:6]
    glossy = maps.shape[2] == GLOSSY_CHANNELS
    alpha2, metallic = (
        (maps[..., 6], maps[..., 7]) if glossy else (np.ones_like(square), np.zeros_like(square))
    )
    alpha2 = alpha2 + np.maximum(square - (slopes**2).sum(-1), 0.0)
    return Maps(
        level,
        material.lattice.aspect,
        np.clip(base, 0.0, 1.0),
        slopes,
        np.clip(alpha2, _LEAST_ALPHA2, 1.0) ** 0.25,
        np.clip(metallic, 0.0, 1.0),
        opacity_of(material, level),
        float(weights[DIELECTRIC]) if glossy else 0.0,
        weights[HEIGHTS][..., 0].cpu().double().numpy(),
    )


def coefficients(maps: Maps, pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Reflectance M of all texels in 1/sr, as ``constant + base_color · factor``: both (texels, k), in the
    precision of the pairs."""
    slopes, alpha2, metallic, opacity = (
        torch.from_numpy(np.ascontiguousarray(a)).to(pairs.half.dtype)
        for a in (
            maps.slopes.reshape(-1, 2),
            maps.roughness.ravel() ** 4,
            maps.metallic.ravel(),
            maps.opacity,
        )
    )
    constant, factor = affine(slopes, alpha2, metallic, maps.dielectric, pairs)
    covered = opacity.reshape(-1, 1)
    return constant * covered, factor * covered


def evaluate_maps(maps: Maps, omega_i: F64, omega_o: F64) -> F64:
    """Reflectance M of all texels in 1/sr: radiance for unit irradiance of the reference plane.

    Parameters
    ----------
    omega_i, omega_o : (k, 3) arrays
        Unit vectors towards light and viewer.

    Returns
    -------
    (rows, columns, k, 3) array
    """
    constant, factor = (c.numpy() for c in coefficients(maps, Pairs.of(omega_i, omega_o)))
    base = maps.base_color.reshape(-1, 1, 3)
    out: F64 = constant[..., None] + base * factor[..., None]
    return out.reshape(*maps.roughness.shape, len(omega_i), 3)
