r"""Maps of the metallic-roughness model of glTF 2.0 for a material.

They are those of the surface that the model traces. The scatter of slopes below the texels of a level widens
the lobe (:mod:`mbtf_fit.surface.slopes`). Maps of models that know no surface are fitted to their values
(:mod:`~mbtf_fit.maps.brdf_fit`). Maps show no shadows, interreflection or parallax of their own. Their
base color is therefore scaled until the mean reflectance of the tile, over cosine-weighted lights and views,
is that of the neural material.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_core.app.console import Console
from mbtf_core.data.lattice import texel_centers
from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_core.errors import UsageError
from mbtf_core.stats import Estimate, unexplained_variance
from mbtf_fit.maps.brdf_fit import BASE, METALLIC, ROUGHNESS, SLOPES, Pairs, fit_tile, reflectance
from mbtf_fit.maps.reference_values import (
    direction_pairs,
    followed,
    least_cosine,
    steep_views,
    texel_values,
    tile_means,
)
from mbtf_fit.material.material import Material
from mbtf_fit.ops.constants import (
    COATED_CHANNELS,
    DIELECTRIC,
    FIBERS,
    GLOSSY_CHANNELS,
    HEIGHTS,
    LEAST_TANGENTS,
    MAPS,
)

F64 = NDArray[np.float64]
# Least roughness: smaller lobes are narrower than those that data are made with.
_LEAST_ALPHA2 = 1e-4
# Pairs of light and view whose tile means are compared, how many are evaluated at once, and at how many
# texels along a side; most factor on the base color.
_PAIRS, _AT_ONCE, _TEXELS, _MOST_FACTOR = 512, 32, 128, 64.0
# Steep views, lights of each, and texels along a side, whose values are compared one by one.
_VIEWS, _LIGHTS, _COMPARED_TEXELS = 16, 4, 64


@dataclass(frozen=True)
class Maps:
    """Maps (rows, columns, ...) of one level, row 0 at ``v → 1``.

    Attributes
    ----------
    level : int
    aspect : height of the tile over its width
    base_color : (rows, columns, 3), linear, in [0, 1]
    slopes : (rows, columns, 2), ∂z/∂x and ∂z/∂y
    roughness, metallic, opacity : (rows, columns), in [0, 1]; opacity towards the normal
    dielectric : F0 of the dielectric; 0 for a surface without gloss
    heights : (H, W), in tile widths, at most 0, on the grid that rays are traced to; None of a model that
        knows no surface
    coat : (rows, columns, 2), weight and roughness of the clear coat, whose normal is that of the rest; None
        without one
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
    coat: F64 | None = None

    @property
    def normals(self) -> F64:
        """Unit normals (rows, columns, 3): x along u, y along v."""
        n = np.concatenate([-self.slopes, np.ones((*self.slopes.shape[:2], 1))], -1)
        out: F64 = n / np.linalg.norm(n, axis=-1, keepdims=True)
        return out

    @property
    def height_range(self) -> float:
        """Highest minus lowest vertex, in tile widths; 0 without heights."""
        return 0.0 if self.heights is None else float(np.ptp(self.heights))

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
        source = "fit" if self.heights is None else "surface"
        return {"level": self.level, "source": source, "dielectric_f0": self.dielectric}

    def __str__(self) -> str:
        rows, columns = self.roughness.shape
        kind = "fitted to the values of" if self.heights is None else "of the surface, at"
        return f"maps {kind} {columns} x {rows} texels (level {self.level})"

    def coefficients(self, omega_i: F64, omega_o: F64) -> tuple[F64, F64]:
        """Reflectance M of all texels in 1/sr, as ``constant + base_color · factor``: both (texels, k)."""
        lobes = [*self.slopes.reshape(-1, 2).T, self.roughness.ravel(), self.metallic.ravel()]
        pairs = Pairs.of(omega_i, omega_o, torch.float64)
        found = reflectance(torch.from_numpy(np.stack(lobes)[..., None]), self.dielectric, pairs)
        opacity = self.opacity.reshape(-1, 1)
        constant, factor = (c.numpy() * opacity for c in found)
        if self.coat is None:
            return constant, factor
        # The extension KHR_materials_clearcoat: a dielectric of 1.5, mixed by its reflectance at the normal.
        weight, roughness = self.coat.reshape(-1, 2).T
        mirror = np.stack([*lobes[:2], roughness, np.ones_like(weight)])
        lobe = sum(c.numpy() for c in reflectance(torch.from_numpy(mirror[..., None]), 0.0, pairs))
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


def knows_surface(material: Material) -> bool:
    """Whether the model traces and shades a surface, whose maps then explain its values."""
    return material.model.tracing is not None


def opacity_of(material: Material, level: int) -> F64:
    """Opacity (rows, columns) towards the normal of the texels of a level."""
    if material.transmittance is None:
        return np.ones(material.lattice.shape(level))
    return 1.0 - material.transmittance.from_above(level).astype(np.float64)


def surface_maps(material: Material, level: int) -> Maps:
    """Maps of a level that a material knows of its surface (:func:`knows_surface`)."""
    weights = material.model.weights()
    maps = weights[f"{MAPS}.{level}"].cpu().double().numpy()
    slopes, base = maps[..., :2], maps[..., 5:8]
    if f"{FIBERS}.{level}" in weights:
        # The color of the fibers: gaps, which are black, are in the opacity.
        moments = weights[f"{FIBERS}.{level}"].cpu().double().numpy()
        base = base / np.maximum(moments[..., [0, 3, 5]].sum(-1, keepdims=True), LEAST_TANGENTS)
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


def fitted_maps(material: Material, level: int, console: Console) -> Maps:
    """Maps of a level, without heights, that are fitted to the values of a material."""
    with console.progress(total=material.lattice.texels(level), label="fitting maps") as bar:
        x, dielectric = fit_tile(material, level, bar.advance)
    lobes = (x[..., BASE], x[..., SLOPES], x[..., ROUGHNESS], x[..., METALLIC])
    return Maps(level, material.lattice.aspect, *lobes, opacity_of(material, level), dielectric, None)


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


def make_maps(material: Material, level: int | None, console: Console) -> tuple[Maps, Estimate]:
    """Maps of a level, and their unexplained variance.

    Parameters
    ----------
    material : Material
    level : the finest by default
    console : for the progress of a fit

    Returns
    -------
    (Maps, Estimate)

    Raises
    ------
    UsageError : the material has no such level
    """
    finest = material.lattice.finest
    level = finest if level is None else level
    if not 0 <= level <= finest:
        raise UsageError(f"the material has the levels 0 to {finest}", where="--level")
    known = knows_surface(material)
    maps = surface_maps(material, level) if known else fitted_maps(material, level, console)
    maps = scale_color(material, maps)
    return maps, unexplained(material, maps)
