"""Maps fitted to values: known BRDFs of asymmetric maps are recovered, and the mean reflectance is kept."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from support.plugin_materials import write_material

from mbtf_core.app.console import Console
from mbtf_core.data.lattice import Lattice, texel_centers
from mbtf_core.directions import normalize
from mbtf_fit.maps.brdf_fit import fit_texels
from mbtf_fit.maps.maps import Maps, fitted_maps, scale_color, unexplained
from mbtf_fit.maps.reference_values import (
    direction_pairs,
    followed,
    steep_views,
    tile_means,
)
from mbtf_fit.material.material import Material
from mbtf_fit.material.transmittance import Transmittance

F64 = NDArray[np.float64]
# BRDF times cosine of texels (n, 2) [row, column] for directions in the frame of their normals.
Lobe = Callable[[NDArray[np.int64], F64, F64], F64]


@dataclass(frozen=True)
class KnownBrdf(Material):
    """A material whose value at each texel is that of a BRDF around a normal; footprints of level 0 have the
    mean.

    Attributes
    ----------
    slopes : (rows, columns, 2) array
    lobe : Lobe
    """

    slopes: Any = None
    lobe: Any = None

    def evaluate(
        self, u: ArrayLike, sigma: ArrayLike, omega_i: ArrayLike, omega_o: ArrayLike
    ) -> NDArray[np.float32]:
        rows, columns = self.slopes.shape[:2]
        light, view = (np.asarray(omega, np.float64) for omega in (omega_i, omega_o))
        if np.min(sigma) >= 0.5:
            texels = np.stack(np.mgrid[:rows, :columns], -1).reshape(-1, 2)
            means = [self._at(np.broadcast_to(texel, (len(light), 2)), light, view) for texel in texels]
            return np.mean(means, 0).astype(np.float32)
        at = np.asarray(u, np.float64) % 1.0
        column = np.floor(at[:, 0] * columns).astype(int)
        row = rows - 1 - np.floor(at[:, 1] * rows).astype(int)
        return self._at(np.stack([row, column], 1), light, view).astype(np.float32)

    def _at(self, texel: NDArray[np.int64], omega_i: F64, omega_o: F64) -> F64:
        p, q = self.slopes[tuple(texel.T)].T
        normal = normalize(np.stack([-p, -q, np.ones_like(p)], 1))
        along = normalize(np.stack([np.ones_like(p), np.zeros_like(p), p], 1))
        across = np.cross(normal, along)
        light, view = (
            np.stack([(w * axis).sum(1) for axis in (along, across, normal)], 1) for w in (omega_i, omega_o)
        )
        visible = (light[:, 2] > 0) & (view[:, 2] > 0)
        value = np.where(visible[:, None], self.lobe(texel, light, view), 0.0)
        out: F64 = value / omega_i[:, 2:]
        return out


def known_brdf(folder: Path, slopes: F64, lobe: Lobe, **options: Any) -> KnownBrdf:
    """A material of slopes (rows, columns, 2) and of BRDFs; the number of columns is a power of two."""
    rows, columns = slopes.shape[:2]
    finest = columns.bit_length() - 1
    made = write_material(folder, model="neumip-baseline", finest=finest, aspect=rows / columns, **options)
    given = {field.name: getattr(made, field.name) for field in fields(made)}
    return KnownBrdf(**given, slopes=slopes, lobe=lobe)


def gltf_brdf(base: F64, roughness: F64, metallic: F64) -> Lobe:
    """The metallic-roughness BRDF times the cosine, by the equations of glTF 2.0, appendix B.3, for maps
    (rows, columns, ...); with the visibility of the Khronos sample viewer."""

    def lobe(texel: NDArray[np.int64], light: F64, view: F64) -> F64:
        row, column = texel.T
        color, m = base[row, column], metallic[row, column][:, None]
        alpha = (roughness[row, column] ** 2)[:, None]
        half = normalize(light + view)
        nl, nv = (np.maximum(w[:, 2:], 1e-6) for w in (light, view))
        nh, vh = half[:, 2:], (view * half).sum(1, keepdims=True)
        d = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
        v = 0.5 / (
            nl * np.sqrt(nv**2 * (1 - alpha**2) + alpha**2) + nv * np.sqrt(nl**2 * (1 - alpha**2) + alpha**2)
        )
        schlick = (1 - vh) ** 5
        dielectric = 0.04 + 0.96 * schlick
        mixed = (1 - dielectric) * color / np.pi + dielectric * d * v
        metal = (color + (1 - color) * schlick) * d * v
        return ((1 - m) * mixed + m * metal) * nl

    return lobe


def fitted(material: Material, level: int) -> Maps:
    return fitted_maps(material, level, Console(quiet=True))


def asymmetric_maps(rows: int = 4, columns: int = 8) -> dict[str, Any]:
    """Maps without symmetry: a flip or a transposition of any changes them."""
    j, i = np.mgrid[:rows, :columns] / np.array([rows, columns])[:, None, None]
    return {
        "slopes": np.stack([0.5 * np.sin(5 * i + 1) - 0.2 * j, 0.4 * np.cos(4 * j + 2 * i)], -1),
        "base": np.stack([0.15 + 0.7 * i, 0.8 - 0.6 * j, 0.3 + 0.4 * i * j], -1),
        "roughness": 0.2 + 0.5 * j + 0.2 * i,
        "metallic": np.where((i > 0.5) & (j < 0.5), 1.0, 0.0),
    }


def glossy(folder: Path) -> tuple[KnownBrdf, dict[str, Any]]:
    known = asymmetric_maps()
    return known_brdf(
        folder, known["slopes"], gltf_brdf(*(known[n] for n in ("base", "roughness", "metallic")))
    ), known


def test_a_known_metallic_roughness_brdf_is_recovered(tmp_path: Path) -> None:
    material, known = glossy(tmp_path)
    maps = fitted(material, 3)
    assert maps.dielectric == 0.04
    assert maps.heights is None
    np.testing.assert_allclose(maps.slopes, known["slopes"], atol=0.01)
    np.testing.assert_allclose(maps.roughness, known["roughness"], atol=0.01)
    np.testing.assert_allclose(maps.metallic, known["metallic"], atol=0.02)
    np.testing.assert_allclose(maps.base_color, known["base"], atol=0.02)
    for name, map_ in (("slopes", maps.slopes), ("roughness", maps.roughness), ("base", maps.base_color)):
        for flipped in (map_[::-1], map_[:, ::-1]):
            assert np.abs(flipped - known[name]).max() > 0.1


def test_the_mean_reflectance_and_the_error(tmp_path: Path) -> None:
    """With other lights and views than those of the fit."""
    material, _ = glossy(tmp_path)
    maps = scale_color(material, fitted(material, 3))
    assert unexplained(material, maps).value < 0.001
    plain = replace(maps, slopes=0 * maps.slopes, roughness=np.ones((4, 8)), metallic=np.zeros((4, 8)))
    error = unexplained(material, plain)
    assert error.value > 0.3
    assert 0 < error.error < error.value
    light, view = direction_pairs(512, 0.1, seed=7)
    ours = maps.evaluate(light, view).mean((0, 1))
    np.testing.assert_allclose(ours / tile_means(material, light, view).mean(0), 1, rtol=0.01)


def test_noise_makes_no_lobes(tmp_path: Path) -> None:
    """Networks deviate from their data: a Lambert surface with an error of 20% stays rough and no metal."""
    known, random = asymmetric_maps(), np.random.default_rng(0)

    def noisy(texel: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
        return (
            known["base"][tuple(texel.T)]
            / math.pi
            * light[:, 2:]
            * np.exp(0.2 * random.normal(size=light.shape))
        )

    material = known_brdf(tmp_path, known["slopes"], noisy)
    assert fitted(material, 3).dielectric == 0
    x, _, _ = fit_texels(material, 3, texel_centers(4, 8).reshape(-1, 2), 0.04)
    assert np.quantile(x[:, 2], 0.25) > 0.85
    assert np.quantile(x[:, 3], 0.75) < 0.1


def test_few_glossy_texels_are_enough(tmp_path: Path) -> None:
    """One of 32 texels of a rough tile, whose noise hides it in the mean."""
    slopes, random = np.zeros((4, 8, 2)), np.random.default_rng(0)
    roughness = np.ones((4, 8))
    roughness[1, 2] = 0.4
    exact = gltf_brdf(np.full((4, 8, 3), 0.4), roughness, np.zeros((4, 8)))

    def noisy(texel: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
        rough = roughness[tuple(texel.T)][:, None] == 1
        scale = np.where(rough, np.exp(0.9 * random.normal(size=light.shape)), 1.0)
        out: np.ndarray = exact(texel, light, view) * scale
        return out

    maps = fitted(known_brdf(tmp_path, slopes, noisy), 3)
    assert maps.dielectric == 0.04
    assert maps.roughness[1, 2] == pytest.approx(0.4, abs=0.01)


def test_rough_conductors_of_mitsuba(tmp_path: Path) -> None:
    """Another implementation of GGX: its reflectance does not rise to white at grazing angles."""
    from mbtf_gen.engine.runtime import load_mitsuba

    mi = load_mitsuba()
    color, alphas = np.array([0.8, 0.5, 0.3]), np.array([0.06, 0.15, 0.3, 0.5])
    lobes = [
        mi.load_dict(
            {
                "type": "roughconductor",
                "material": "none",
                "distribution": "ggx",
                "alpha": float(alpha),
                "specular_reflectance": {"type": "rgb", "value": color.tolist()},
            }
        )
        for alpha in alphas
    ]

    def conductor(texel: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
        out = np.zeros((len(texel), 3))
        for column, lobe in enumerate(lobes):
            some = texel[:, 1] == column
            si = mi.SurfaceInteraction3f()
            si.wi = mi.Vector3f(*view[some].T.astype(np.float32))
            wo = mi.Vector3f(*light[some].T.astype(np.float32))
            out[some] = np.asarray(lobe.eval(mi.BSDFContext(), si, wo)).reshape(3, -1).T
        return out

    slopes = np.array([[[0.1, -0.3], [-0.4, 0.2], [0.0, 0.25], [0.3, 0.0]]])
    maps = fitted(known_brdf(tmp_path, slopes, conductor), 2)
    np.testing.assert_allclose(maps.slopes, slopes, atol=0.01)
    np.testing.assert_allclose(maps.roughness[0], np.sqrt(alphas), rtol=0.05)
    np.testing.assert_allclose(maps.metallic, 1, atol=0.05)
    np.testing.assert_allclose(maps.base_color, np.broadcast_to(color, (1, 4, 3)), atol=0.06)


def test_values_are_divided_by_what_the_view_meets(tmp_path: Path) -> None:
    """The opacity has a map of its own; texels that no view meets have the mean color."""
    lattice, value = Lattice(2, 1.0), 0.2
    levels = [np.zeros((*lattice.shape(s), 6), np.float32) for s in range(3)]
    levels[2][:, :2, 0] = 0.75
    levels[2][3, 3, 0] = 1.0
    through = Transmittance(lattice, (0.0,), [levels])
    slopes = np.zeros((4, 4, 2))

    def premultiplied(texel: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
        out: np.ndarray = value * (1 - levels[2][tuple(texel.T)][:, :1]) * light[:, 2:] * np.ones(3)
        return out

    material = known_brdf(tmp_path, slopes, premultiplied, transmittance=through)
    maps = fitted(material, 2)
    np.testing.assert_allclose(maps.opacity, 1 - levels[2][..., 0])
    np.testing.assert_allclose(maps.base_color, math.pi * value, rtol=0.01)
    np.testing.assert_allclose(maps.evaluate(*direction_pairs(8, 0.5))[0], 0.25 * value, rtol=0.01)


def test_views_follow_the_offset(tmp_path: Path) -> None:
    """They see the point that the normal view sees: position plus offset is the same."""
    material = write_material(tmp_path, aspect=0.5, contrast=0.05, brightness=0.0)
    u, views = np.random.default_rng(0).random((20, 2)), steep_views(8)
    at = followed(material, u, views)
    size = np.array([1.0, 0.5])
    seen = u + material.offset(u, np.tile([0.0, 0.0, 1.0], (20, 1))) / size
    for k, view in enumerate(views):
        found = at[:, k] + material.offset(at[:, k], np.tile(view, (20, 1))) / size
        np.testing.assert_allclose(found, seen, atol=2e-3)
    assert np.abs(at - u[:, None]).max() > 0.005


def test_values_of_the_maps_are_those_of_the_specification(tmp_path: Path) -> None:
    material, known = glossy(tmp_path)
    lobes = (known[name] for name in ("base", "slopes", "roughness", "metallic"))
    maps = Maps(3, 0.5, *lobes, np.ones((4, 8)), 0.04, None)
    light, view = direction_pairs(64, 0.1)
    u = np.repeat(texel_centers(4, 8).reshape(-1, 2), 64, 0)
    expected = material.evaluate(u, np.full(len(u), 0.1), np.tile(light, (32, 1)), np.tile(view, (32, 1)))
    np.testing.assert_allclose(maps.evaluate(light, view).reshape(-1, 3), expected, rtol=1e-3, atol=1e-6)
