"""Agreement of maps with the neural material that they are made of.

No map has the shadows, interreflection and parallax of a surface, and clamped parameters or few lobes change
what is fitted. The base color is scaled until the mean reflectance of the tile, over cosine-weighted lights
and views, is that of the neural material.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from mbtf_core.data.lattice import texel_centers
from mbtf_fit.material.interchange.brdf import Pairs
from mbtf_fit.material.interchange.maps import Maps, coefficients
from mbtf_fit.material.interchange.values import (
    direction_pairs,
    followed,
    least_cosine,
    one_thread_each,
    steep_views,
    texel_values,
    tile_means,
)
from mbtf_fit.material.material import Material

F64 = NDArray[np.float64]
# Pairs of light and view whose tile means are compared, and how many are evaluated at once; texels along a
# side that the maps are evaluated at.
_PAIRS, _AT_ONCE, _TEXELS = 512, 32, 128
# Steep views, lights of each, and texels along a side, whose values are compared one by one.
_COMPARED_VIEWS, _LIGHTS, _COMPARED_TEXELS = 16, 4, 64


@dataclass(frozen=True)
class Agreement:
    """Mean reflectance of the tile by the maps, over that of the neural material.

    Attributes
    ----------
    factor : (3,) array
        Factor on the base color, before it is clipped to 1.
    before, after : (3,) arrays
        Ratio of the means over lights and views, with their own base color and with the scaled one.
    spread : float
        RMS difference of tile means over lights and views after the fit, in units of the mean; all colors.
    points_diffuse, points : float
        RMS difference over points of the surface, lights and steep views, in units of the mean value: of a
        diffuse plane with the mean color of each point, and of the maps.
    """

    factor: F64
    before: F64
    after: F64
    spread: float
    points_diffuse: float
    points: float

    def __str__(self) -> str:
        def text(values: F64) -> str:
            return ", ".join(f"{v:.3f}" for v in values)

        return (
            f"mean reflectance of the maps over the material's (RGB): {text(self.before)} with their "
            f"own base color, {text(self.after)} as written\n"
            f"RMS difference of tile means over lights and views: {self.spread:.0%} of the mean\n"
            f"RMS difference of points over lights and steep views, in units of the mean value: "
            f"{self.points:.2f} as written, {self.points_diffuse:.2f} for a diffuse plane of the mean colors"
        )


def _thinned(maps: Maps, side: int) -> tuple[Maps, F64]:
    """The maps at evenly spread texels, at most `side` squared, and their uv (n, 2)."""
    rows, columns = maps.roughness.shape
    j = np.unique(np.linspace(0, rows - 1, min(rows, side)).round().astype(int))
    i = np.unique(np.linspace(0, columns - 1, min(columns, side)).round().astype(int))
    picked = {
        name: getattr(maps, name)[j][:, i]
        for name in ("base_color", "slopes", "roughness", "metallic", "opacity")
    }
    return replace(maps, **picked), texel_centers(rows, columns)[j][:, i].reshape(-1, 2)


def _in_parts(maps: Maps, omega_i: F64, omega_o: F64) -> Iterator[tuple[F64, F64]]:
    """Coefficients (texels, at most 32) of the maps for some pairs after the other."""
    for start in range(0, len(omega_i), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        with one_thread_each():
            constant, factor = coefficients(maps, Pairs.of(omega_i[part], omega_o[part], torch.float32))
        yield constant.double().numpy(), factor.double().numpy()


def _compare_points(material: Material, maps: Maps) -> tuple[float, float]:
    """RMS difference from the values of points, in units of their mean: of mean colors and of the maps."""
    thin, u = _thinned(maps, _COMPARED_TEXELS)
    views = steep_views(_COMPARED_VIEWS, seed=1)
    omega_i, _ = direction_pairs(_COMPARED_VIEWS * _LIGHTS, least_cosine(material), seed=1)
    omega_o = np.tile(views, (_LIGHTS, 1))
    at = np.tile(followed(material, u, views), (1, _LIGHTS, 1))
    values = texel_values(material, maps.level, at, omega_i, omega_o)[0].astype(np.float64)
    base = thin.base_color.reshape(-1, 1, 3)
    found = np.concatenate(
        [c[..., None] + base * f[..., None] for c, f in _in_parts(thin, omega_i, omega_o)], 1
    )
    unit = values.mean() or 1.0
    constant, ours = (values - values.mean(1, keepdims=True)), values - found
    return float(np.sqrt((constant**2).mean()) / unit), float(np.sqrt((ours**2).mean()) / unit)


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
    omega_i, omega_o = direction_pairs(_PAIRS, least_cosine(material))
    wanted = tile_means(material, omega_i, omega_o)
    target = wanted.mean(0)
    thin, _ = _thinned(maps, _TEXELS)
    base = thin.base_color.reshape(-1, 3)
    sums = [(c.sum(1), f.sum(1)) for c, f in _in_parts(thin, omega_i, omega_o)]
    constant, factor = (sum(terms) / _PAIRS for terms in zip(*sums, strict=True))

    def mean(scale: F64) -> F64:
        out: F64 = constant.mean() + (np.clip(base * scale, 0.0, 1.0) * factor[:, None]).mean(0)
        return out

    low, high = np.zeros(3), np.full(3, 2.0)
    while (mean(high) < target).any() and high.max() < 64.0:
        high = np.where(mean(high) < target, 2.0 * high, high)
    for _ in range(30):
        middle = 0.5 * (low + high)
        less = mean(middle) < target
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    scale = 0.5 * (low + high)
    fitted = replace(maps, base_color=np.clip(maps.base_color * scale, 0.0, 1.0))
    scaled = np.clip(base * scale, 0.0, 1.0)
    after = np.concatenate(
        [c.mean(0)[:, None] + f.T @ scaled / len(scaled) for c, f in _in_parts(thin, omega_i, omega_o)]
    )
    safe = np.where(target > 0, target, 1.0)
    difference = float(np.sqrt(((after - wanted) ** 2).mean()))
    agreement = Agreement(
        scale,
        mean(np.ones(3)) / safe,
        after.mean(0) / safe,
        difference / (float(wanted.mean()) or 1.0),
        *_compare_points(material, fitted),
    )
    return fitted, agreement
