r"""Maps of the metallic-roughness model of glTF 2.0 for a material.

They are those of the surface that the model traces. The scatter of slopes below the texels of a level widens
the lobe (:mod:`mbtf_fit.surface.slopes`). Maps show no shadows, interreflection or parallax of their own.
Their base color is scaled until the mean reflectance of the tile, over cosine-weighted lights and views,
is that of the neural material.

The BRDF is that of glTF 2.0, appendix B. A dielectric of diffuse base color c under a GGX lobe of reflectance
F0 is blended with a metal of GGX alone:

    f = (1 - m) [(1 - F) c / π + F L] + m [c + (1 - c) S] L,    F = F0 + (1 - F0) S,    S = (1 - ω_o·h)^5

with the metallic m, the half vector h and L = D V of the height-correlated Smith masking (Heitz 2014), α the
square of the roughness. F0 = 0 stands for a surface without gloss: F is 0 at all angles. The value is the
radiance for unit irradiance of the reference plane, M = f (n·ω_i) / ω_i.z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.quasirandom import SobolEngine

from mbtf_core.data.lattice import sigma_of_level, texel_centers
from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_core.directions import from_projected_disk
from mbtf_core.errors import InputError, UsageError
from mbtf_core.stats import Estimate, unexplained_variance
from mbtf_fit.material.format import DEFAULT_MIN_COS
from mbtf_fit.material.material import Material
from mbtf_fit.ops.constants import COATED_CHANNELS, DIELECTRIC, GLOSSY_CHANNELS, HEIGHTS, MAPS

F64 = NDArray[np.float64]
# Least roughness: smaller lobes are narrower than those that data are made with.
_LEAST_ALPHA2 = 1e-4
# Pairs of light and view whose tile means are compared, how many are evaluated at once, and at how many
# texels along a side; most factor on the base color.
_PAIRS, _AT_ONCE, _TEXELS, _MOST_FACTOR = 512, 32, 128, 64.0
# Steep views, lights of each, and texels along a side, whose values are compared one by one.
_VIEWS, _LIGHTS, _COMPARED_TEXELS = 16, 4, 64
# Greatest sine of steep views, 45° to the normal, which parallax hardly moves.
_STEEP = 0.7
# Positions along a side, for the footprint of the whole tile; iterations to find the point that a view sees.
_SIDE, _ITERATIONS = 4, 4
# Least cosine to the normal of what is visible.
_LEAST_COSINE = 1e-6


def reflectance(lobes: F64, dielectric: float, omega_i: F64, omega_o: F64) -> tuple[F64, F64]:
    """Value of texels in 1/sr, as ``constant + base_color · factor``, which all three colors share.

    Parameters
    ----------
    lobes : (4, n) array, ∂z/∂x and ∂z/∂y of the shading normal, the square root of α of GGX (roughness), the
        share of metal
    dielectric : F0 of the dielectric
    omega_i, omega_o : (k, 3) unit vectors towards light and viewer, ``z > 0``

    Returns
    -------
    (constant, factor) : (n, k) arrays, 0 where the light or the viewer is below the surface
    """
    to_light, to_view = (
        torch.from_numpy(np.array(omega.T, np.float64, order="C")) for omega in (omega_i, omega_o)
    )
    half = torch.nn.functional.normalize(to_light + to_view, dim=0)
    schlick = (1.0 - (to_view * half).sum(0).clamp(0.0, 1.0)) ** 5
    p, q, roughness, metal = torch.from_numpy(lobes)[..., None]
    length = (1.0 + p * p + q * q).rsqrt()

    def cosine(omega: Tensor) -> Tensor:
        return (omega[2] - p * omega[0] - q * omega[1]) * length

    light, view, peak = cosine(to_light), cosine(to_view), cosine(half).clamp_min(0.0)
    visible = (light > 0) & (view > 0)
    light, view = light.clamp_min(_LEAST_COSINE), view.clamp_min(_LEAST_COSINE)
    alpha2 = roughness**4
    rest = 1.0 - alpha2
    masking = light * (view * view * rest + alpha2).sqrt() + view * (light * light * rest + alpha2).sqrt()
    lobe = alpha2 / (2.0 * math.pi * (1.0 - peak * peak * rest) ** 2 * masking)
    fresnel = dielectric + (1.0 - dielectric) * schlick if dielectric > 0 else torch.zeros_like(schlick)
    constant = (fresnel + metal * (schlick - fresnel)) * lobe
    factor = (1.0 - metal) * ((1.0 - fresnel) / math.pi) + metal * (1.0 - schlick) * lobe
    foreshortening = torch.where(visible, light, 0.0) / to_light[2]
    return (constant * foreshortening).numpy(), (factor * foreshortening).numpy()


@dataclass(frozen=True)
class Maps:
    """Maps (rows, columns, ...) of one level, row 0 at ``v → 1``.

    Attributes
    ----------
    aspect : height of the tile over its width
    base_color : (rows, columns, 3) array, linear, in [0, 1]
    slopes : (rows, columns, 2) array, ∂z/∂x and ∂z/∂y
    roughness, metallic, opacity : (rows, columns) arrays, in [0, 1]; opacity towards the normal
    dielectric : F0 of the dielectric; 0 for a surface without gloss
    heights : (H, W) array, in tile widths, at most 0, on the grid that rays are traced to
    coat : (rows, columns, 2) array or None, weight and roughness of the clear coat, whose normal is that of
        the rest; None without one
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
    coat: F64 | None = None

    @property
    def normals(self) -> F64:
        """Unit normals (rows, columns, 3): x along u, y along v."""
        n = np.concatenate([-self.slopes, np.ones((*self.slopes.shape[:2], 1))], -1)
        out: F64 = n / np.linalg.norm(n, axis=-1, keepdims=True)
        return out

    @property
    def height_range(self) -> float:
        """Highest minus lowest vertex, in tile widths."""
        return float(np.ptp(self.heights))

    @property
    def has_holes(self) -> bool:
        """Whether the base color has an alpha channel."""
        return bool(self.opacity.min() < 1.0)

    @property
    def refractive_index(self) -> float:
        """That of the dielectric; 1 for a surface without gloss."""
        root = math.sqrt(min(max(self.dielectric, 0.0), 0.99))
        return (1.0 + root) / (1.0 - root)

    def as_dict(self) -> dict[str, Any]:
        """What they are, as plain data."""
        return {"level": self.level, "dielectric_f0": self.dielectric}

    def __str__(self) -> str:
        rows, columns = self.roughness.shape
        return f"maps of the surface, at {columns} x {rows} texels (level {self.level})"

    def coefficients(self, omega_i: F64, omega_o: F64) -> tuple[F64, F64]:
        """Reflectance M of all texels in 1/sr, as ``constant + base_color · factor``: both (texels, k)."""
        lobes = np.stack([*self.slopes.reshape(-1, 2).T, self.roughness.ravel(), self.metallic.ravel()])
        opacity = self.opacity.reshape(-1, 1)
        constant, factor = (c * opacity for c in reflectance(lobes, self.dielectric, omega_i, omega_o))
        if self.coat is None:
            return constant, factor
        # The extension KHR_materials_clearcoat: a dielectric of 1.5, mixed by its reflectance at the normal.
        weight, roughness = self.coat.reshape(-1, 2).T
        mirror = np.stack([*lobes[:2], roughness, np.ones_like(weight)])
        lobe = sum(reflectance(mirror, 0.0, omega_i, omega_o))
        cosine = np.clip(self.normals.reshape(-1, 3) @ np.asarray(omega_o, np.float64).T, 0.0, 1.0)
        share = weight[:, None] * (CLEARCOAT_F0 + (1.0 - CLEARCOAT_F0) * (1.0 - cosine) ** 5)
        return (1.0 - share) * constant + share * lobe * opacity, (1.0 - share) * factor

    def evaluate(self, omega_i: F64, omega_o: F64) -> F64:
        """Reflectance M (texels, k, 3) of all texels in 1/sr, for unit vectors (k, 3)."""
        constant, factor = self.coefficients(omega_i, omega_o)
        out: F64 = constant[..., None] + self.base_color.reshape(-1, 1, 3) * factor[..., None]
        return out

    def thinned(self, side: int) -> tuple[Maps, F64]:
        """The maps at evenly spread texels, at most `side` squared, and their uv (n, 2)."""
        shape = self.roughness.shape
        j, i = (np.unique(np.linspace(0, n - 1, min(n, side)).round().astype(int)) for n in shape)
        names = ["base_color", "slopes", "roughness", "metallic", "opacity"]
        names += [] if self.coat is None else ["coat"]
        picked = {name: getattr(self, name)[j][:, i] for name in names}
        return replace(self, **picked), texel_centers(*shape)[j][:, i].reshape(-1, 2)


def opacity_of(material: Material, level: int) -> F64:
    """Opacity (rows, columns) towards the normal of the texels of a level."""
    if material.transmittance is None:
        return np.ones(material.lattice.shape(level))
    through = np.clip(material.transmittance.levels[level][..., 0], 0.0, 1.0)
    return 1.0 - through.astype(np.float64)


def surface_maps(material: Material, level: int) -> Maps:
    """Maps of a level that a material knows of its surface."""
    weights = material.model.weights()
    maps = weights[f"{MAPS}.{level}"].cpu().double().numpy()
    slopes, base = maps[..., :2], maps[..., 5:8]
    glossy = maps.shape[2] >= GLOSSY_CHANNELS
    alpha2, metallic = (
        (maps[..., 8], maps[..., 9]) if glossy else (np.ones_like(base[..., 0]), np.zeros_like(base[..., 0]))
    )
    # Facets are isotropic: the mean of both axes of 2C.
    scatter = np.maximum(maps[..., 2] + maps[..., 4] - (slopes**2).sum(-1), 0.0)
    coat = None
    if maps.shape[2] == COATED_CHANNELS:
        coat = np.stack([np.clip(maps[..., 10], 0.0, 1.0), _roughness(maps[..., 11] + scatter)], -1)
    return Maps(
        level,
        material.lattice.aspect,
        np.clip(base, 0.0, 1.0),
        slopes,
        _roughness(alpha2 + scatter),
        np.clip(metallic, 0.0, 1.0),
        opacity_of(material, level),
        float(weights[DIELECTRIC]) if glossy else 0.0,
        weights[HEIGHTS][..., 0].cpu().double().numpy(),
        coat,
    )


def _roughness(alpha2: F64) -> F64:
    return np.asarray(np.clip(alpha2, _LEAST_ALPHA2, 1.0) ** 0.25)


def least_cosine(material: Material) -> float:
    """Least cosine of the directions of the material's data."""
    return float(material.description["data"].get("min_cos", DEFAULT_MIN_COS))


def direction_pairs(count: int, least: float, seed: int = 0) -> tuple[F64, F64]:
    """Lights and views (count, 3), cosine-weighted, with cosines of at least `least`."""
    engine = SobolEngine(4, scramble=True, seed=seed)
    points = np.asarray(engine.draw(count, dtype=torch.float64).numpy(), np.float64)
    radius = np.sqrt((1.0 - least**2) * points[:, [0, 2]])
    angle = 2.0 * np.pi * points[:, [1, 3]]
    omega = from_projected_disk(np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1))
    return omega[:, 0], omega[:, 1]


def steep_views(count: int, seed: int) -> F64:
    """Views (count, 3), cosine-weighted, within 45° of the normal.

    Maps have no parallax. Steep views show the same points of a surface, wherever its heights are.
    """
    return from_projected_disk(_STEEP * direction_pairs(count, 0.0, seed)[1][:, :2])


def followed(material: Material, u: F64, views: F64) -> F64:
    """Positions (n, m, 2) at which views (m, 3) see the points that the normal view sees at `u` (n, 2).

    The offset leads from the reference plane to the point that is seen. Without one they are `u`.
    """
    n, m = len(u), len(views)
    size = np.array([1.0, material.lattice.aspect])
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (n, 3))
    seen = np.repeat(u + material.offset(u, up) / size, m, 0)
    at, all_views = np.repeat(u, m, 0), np.tile(views, (n, 1))
    for _ in range(_ITERATIONS):
        at = seen - material.offset(at, all_views) / size
    return at.reshape(n, m, 2)


def texel_values(material: Material, level: int, u: F64, omega_i: F64, omega_o: F64) -> tuple[F64, F64]:
    """Values of a material with the footprint of a level, and what the views meet of it.

    Parameters
    ----------
    u : (n, k, 2) array, positions, uv
    omega_i, omega_o : (k, 3) or (n, k, 3) arrays

    Returns
    -------
    values : (n, k, 3) array, in 1/sr
    opacity : (n, k) array, one less the transmittance
    """
    n, k = u.shape[:2]
    light, view = (np.broadcast_to(omega, (n, k, 3)).reshape(-1, 3) for omega in (omega_i, omega_o))
    at, sigma = u.reshape(-1, 2), np.full(n * k, float(sigma_of_level(level)))
    values = material.evaluate(at, sigma, light, view).reshape(n, k, 3).astype(np.float64)
    if material.transmittance is None:
        return values, np.ones((n, k))
    return values, 1.0 - material.transmittance.evaluate(at, sigma, view).reshape(n, k).astype(np.float64)


def tile_means(material: Material, omega_i: F64, omega_o: F64) -> F64:
    """Mean reflectance (n, 3) of the tile for pairs of directions: that of the footprint of the whole tile,
    at some positions."""
    u = (np.stack(np.meshgrid(*2 * [np.arange(_SIDE)]), -1).reshape(-1, 1, 2) + 0.5) / _SIDE
    values, _ = texel_values(material, 0, np.tile(u, (1, len(omega_i), 1)), omega_i, omega_o)
    mean: F64 = values.mean(0)
    return mean


def scale_color(material: Material, maps: Maps) -> Maps:
    """The maps with a base color, clipped to [0, 1], that has the mean reflectance of the material."""
    omega_i, omega_o = direction_pairs(_PAIRS, least_cosine(material))
    target = tile_means(material, omega_i, omega_o).mean(0)
    thin, _ = maps.thinned(_TEXELS)
    constant, factor = 0.0, np.zeros((thin.roughness.size, 1))
    for start in range(0, _PAIRS, _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        terms = thin.coefficients(omega_i[part], omega_o[part])
        constant += terms[0].sum() / _PAIRS / len(factor)
        factor += terms[1].sum(1, keepdims=True) / _PAIRS
    scale, base = np.ones(3), thin.base_color.reshape(-1, 3)
    # Some texels are clipped, so that the others need more.
    for _ in range(30):
        mean = (np.clip(scale * base, 0.0, 1.0) * factor).mean(0)
        scale *= np.maximum(target - constant, 0.0) / np.where(mean > 0, mean, 1.0)
        scale = np.clip(scale, 1e-9, _MOST_FACTOR)
    return replace(maps, base_color=np.clip(maps.base_color * scale, 0.0, 1.0))


def unexplained(material: Material, maps: Maps) -> Estimate:
    """Unexplained variance of the maps against the material: of points of the surface, under lights of the
    data, in steep views, which parallax hardly moves."""
    thin, u = maps.thinned(_COMPARED_TEXELS)
    views = steep_views(_VIEWS, seed=1)
    omega_i, _ = direction_pairs(_VIEWS * _LIGHTS, least_cosine(material), seed=1)
    at = np.tile(followed(material, u, views), (1, _LIGHTS, 1))
    omega_o = np.tile(views, (_LIGHTS, 1))
    values, _ = texel_values(material, maps.level, at, omega_i, omega_o)
    return unexplained_variance(thin.evaluate(omega_i, omega_o), values, values)


def make_maps(material: Material, level: int | None) -> tuple[Maps, Estimate]:
    """Maps of a level, and their unexplained variance.

    Parameters
    ----------
    level : the finest by default

    Returns
    -------
    (Maps, Estimate)

    Raises
    ------
    UsageError : the material has no such level
    InputError : its model shades no surface
    """
    if material.model.tracing is None:
        raise InputError(
            f"{material.model.name} shades no surface, whose maps could be written",
            hint="fit relief or neumip+ to the data: --model relief",
        )
    finest = material.lattice.finest
    level = finest if level is None else level
    if not 0 <= level <= finest:
        raise UsageError(f"the material has the levels 0 to {finest}", where="--level")
    maps = scale_color(material, surface_maps(material, level))
    return maps, unexplained(material, maps)
