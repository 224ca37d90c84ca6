"""Maps of a material at one level, for the metallic-roughness model that renderers share.

Models that trace a surface know its filtered maps (:mod:`mbtf_fit.surface.known`): slopes, the mean of their
squares, base color, α², metallic. The variance of the slopes within a texel widens the lobe (LEAN mapping,
Olano and Baker 2010). Shadows, interreflection and parallax are in none of these maps. The base color is
therefore scaled until the mean reflectance of the tile is that of the neural material (:func:`fit_color`).

The target is the BRDF of glTF 2.0, appendix B: a dielectric of diffuse color under a GGX lobe, blended with
a metal of GGX alone; α = roughness².
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mbtf_core.directions import from_projected_disk
from mbtf_core.errors import InputError, UsageError
from mbtf_core.lattice import sigma_of_level
from mbtf_fit.material.material import Material
from mbtf_fit.models.constants import DIELECTRIC, GLOSSY_CHANNELS, HEIGHTS, MAPS

F64 = NDArray[np.float64]
# Pairs of light and view, and positions of the tile, whose means are compared; texels along a side that the
# maps are evaluated at.
_PAIRS, _POSITIONS, _TEXELS = 256, 16, 64
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
    heights : (H, W) array
        In tile widths, at most 0, on the grid that rays are traced to.
    """

    level: int
    aspect: float
    base_color: F64
    slopes: F64
    roughness: F64
    metallic: F64
    opacity: F64
    dielectric: float
    heights: F64

    @property
    def normals(self) -> F64:
        """Unit normals (rows, columns, 3): x along u, y along v."""
        n = np.concatenate([-self.slopes, np.ones((*self.slopes.shape[:2], 1))], -1)
        out: F64 = n / np.linalg.norm(n, axis=-1, keepdims=True)
        return out


@dataclass(frozen=True)
class Agreement:
    """Mean reflectance of the tile by the maps, over that of the neural material.

    Attributes
    ----------
    factor : (3,) array
        Factor on the base color, before it is clipped to 1.
    before, after : (3,) arrays
        Ratio of the means over lights and views, with the surface's own base color and with the fitted one.
    spread : float
        RMS over lights and views of the ratio of tile means, less 1, after the fit; all colors.
    """

    factor: F64
    before: F64
    after: F64
    spread: float

    def __str__(self) -> str:
        def text(values: F64) -> str:
            return ", ".join(f"{v:.3f}" for v in values)

        return (
            f"mean reflectance of the maps over the material's (RGB): {text(self.before)} with the surface's "
            f"base color, {text(self.after)} as written; RMS over lights and views {self.spread:.2f}"
        )


def maps_of(material: Material, level: int | None = None) -> Maps:
    """Maps that a material knows of its surface.

    Parameters
    ----------
    material : Material
    level : int, optional
        The finest by default.

    Returns
    -------
    Maps

    Raises
    ------
    InputError
        The model knows no surface.
    UsageError
        The material has no such level.
    """
    finest = material.lattice.finest
    level = finest if level is None else level
    if not 0 <= level <= finest:
        raise UsageError(f"the material has the levels 0 to {finest}", where="--level")
    weights = material.model.weights()
    if HEIGHTS not in weights:
        raise InputError(
            f"the model '{material.config.model}' knows no surface, whose maps could be written",
            hint="fit the material with --model relief or neumip+",
        )
    maps = weights[f"{MAPS}.{level}"].cpu().double().numpy()
    slopes, square, base = maps[..., :2], maps[..., 2], maps[..., 3:6]
    glossy = maps.shape[2] == GLOSSY_CHANNELS
    alpha2, metallic = (
        (maps[..., 6], maps[..., 7]) if glossy else (np.ones_like(square), np.zeros_like(square))
    )
    alpha2 = alpha2 + np.maximum(square - (slopes**2).sum(-1), 0.0)
    opacity = np.ones_like(square)
    if material.transmittance is not None:
        through = np.clip(material.transmittance.levels[level][..., 0], 0.0, 1.0)
        opacity = 1.0 - through.astype(np.float64)
    return Maps(
        level,
        material.lattice.aspect,
        np.clip(base, 0.0, 1.0),
        slopes,
        np.clip(alpha2, _LEAST_ALPHA2, 1.0) ** 0.25,
        np.clip(metallic, 0.0, 1.0),
        opacity,
        float(weights[DIELECTRIC]) if glossy else 0.0,
        weights[HEIGHTS][..., 0].cpu().double().numpy(),
    )


def evaluate_maps(maps: Maps, omega_i: F64, omega_o: F64) -> F64:
    """Reflectance M of all texels in 1/sr: radiance for unit irradiance of the reference plane.

    Parameters
    ----------
    omega_i, omega_o : (3,) arrays
        Unit vectors towards light and viewer.

    Returns
    -------
    (rows, columns, 3) array
    """
    n, alpha2 = maps.normals, maps.roughness[..., None] ** 4
    light, view = ((n @ omega)[..., None] for omega in (omega_i, omega_o))
    half = (omega_i + omega_o) / np.linalg.norm(omega_i + omega_o)
    cosine = np.maximum(n @ half, 0.0)[..., None]
    lit, seen = np.maximum(light, 1e-3), np.maximum(view, 1e-3)
    facets = alpha2 / (math.pi * (cosine**2 * (alpha2 - 1.0) + 1.0) ** 2)

    def masking(c: F64) -> F64:
        out: F64 = np.sqrt(1.0 + alpha2 * (1.0 / c**2 - 1.0))
        return out

    lobe = facets / (2.0 * (masking(lit) + masking(seen)) * lit * seen)
    schlick = (1.0 - float(omega_o @ half)) ** 5
    base, metallic = maps.base_color, maps.metallic[..., None]
    fresnel = maps.dielectric + (1.0 - maps.dielectric) * schlick if maps.dielectric > 0 else 0.0
    dielectric = (1.0 - fresnel) * base / math.pi + fresnel * lobe
    metal = (base + (1.0 - base) * schlick) * lobe
    value = (1.0 - metallic) * dielectric + metallic * metal
    visible = (light > 0) & (view > 0)
    opacity = maps.opacity[..., None]
    return np.where(visible, opacity * value * light, 0.0) / omega_i[2]


def direction_pairs(count: int, least: float, seed: int = 0) -> tuple[F64, F64]:
    """Lights and views (count, 3), cosine-weighted, with cosines of at least `least`."""
    from scipy.stats import qmc

    points = qmc.Sobol(4, rng=np.random.default_rng(seed)).random(count)
    radius = np.sqrt((1.0 - least**2) * points[:, [0, 2]])
    angle = 2.0 * np.pi * points[:, [1, 3]]
    disk = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)
    omega = from_projected_disk(disk)
    return np.asarray(omega[:, 0], np.float64), np.asarray(omega[:, 1], np.float64)


def tile_means(material: Material, omega_i: F64, omega_o: F64) -> F64:
    """Mean reflectance (n, 3) of the tile by the neural material: that of the footprint of the whole tile, at
    some positions."""
    n = len(omega_i)
    side = round(math.sqrt(_POSITIONS))
    grid = (np.stack(np.meshgrid(*2 * [np.arange(side)]), -1).reshape(-1, 2) + 0.5) / side
    u = np.repeat(grid, n, 0)
    sigma = np.full(len(u), float(sigma_of_level(0)))
    light, view = (np.tile(omega, (len(grid), 1)) for omega in (omega_i, omega_o))
    value = material.evaluate(u, sigma, light, view)
    return np.asarray(value.reshape(len(grid), n, 3).mean(0), np.float64)


def _thinned(maps: Maps) -> Maps:
    """The maps at evenly spread texels."""
    rows, columns = maps.roughness.shape
    j = np.unique(np.linspace(0, rows - 1, min(rows, _TEXELS)).round().astype(int))
    i = np.unique(np.linspace(0, columns - 1, min(columns, _TEXELS)).round().astype(int))
    picked = {
        name: getattr(maps, name)[j][:, i]
        for name in ("base_color", "slopes", "roughness", "metallic", "opacity")
    }
    return replace(maps, **picked)


def fit_color(material: Material, maps: Maps) -> tuple[Maps, Agreement]:
    """Scale the base color so that the tile's mean reflectance, averaged over cosine-weighted lights and
    views, is that of the neural material.

    Parameters
    ----------
    material : Material
    maps : Maps
        Of the same material.

    Returns
    -------
    (Maps, Agreement)
        With the fitted base color, clipped to [0, 1].
    """
    least = float(material.description["data"].get("min_cos", 0.1))
    omega_i, omega_o = direction_pairs(_PAIRS, least)
    wanted = tile_means(material, omega_i, omega_o)
    thin = _thinned(maps)

    def means(factor: F64) -> F64:
        colored = replace(thin, base_color=np.clip(thin.base_color * factor, 0.0, 1.0))
        return np.stack(
            [evaluate_maps(colored, i, o).mean((0, 1)) for i, o in zip(omega_i, omega_o, strict=True)]
        )

    target = wanted.mean(0)
    low, high = np.zeros(3), np.full(3, 2.0)
    before = means(np.ones(3))
    while (means(high).mean(0) < target).any() and high.max() < 64.0:
        high = np.where(means(high).mean(0) < target, 2.0 * high, high)
    for _ in range(20):
        middle = 0.5 * (low + high)
        less = means(middle).mean(0) < target
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    factor = 0.5 * (low + high)
    after = means(factor)
    safe = np.where(target > 0, target, 1.0)
    ratio = np.where(wanted > 0, after / np.where(wanted > 0, wanted, 1.0), 1.0)
    fitted = replace(maps, base_color=np.clip(maps.base_color * factor, 0.0, 1.0))
    agreement = Agreement(
        factor, before.mean(0) / safe, after.mean(0) / safe, float(np.sqrt(((ratio - 1.0) ** 2).mean()))
    )
    return fitted, agreement
