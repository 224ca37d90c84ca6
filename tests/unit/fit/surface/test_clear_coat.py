"""The known surface below a clear coat, against Monte Carlo averages of the generator's BSDF over facets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.known_surfaces import geometry
from support.scenes import mi
from support.surfaces import point, vectors

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.relief import known_surface
from mbtf_fit.surface.hints import compute_hints
from mbtf_fit.surface.known import KnownSurface
from mbtf_gen.render.bsdf.surface import SurfaceParts

assert mi.variant()
F64 = NDArray[np.float64]
LATTICE, PAIRS, FACETS = Lattice(2), 16, 10_000
SLOPE, SCATTER = np.array([0.3, -0.1]), np.array([[0.05, 0.02], [0.02, 0.08]])
COAT = SurfaceParts(diffuse=False, clearcoat=True)


def pairs(least: float) -> tuple[F64, F64]:
    """Lights and views (PAIRS, 3) with cosines of at least `least`."""
    random = np.random.default_rng(4)
    c, azimuth = random.uniform(least, 1, (2, PAIRS)), random.uniform(0, 2 * np.pi, (2, PAIRS))
    s = np.sqrt(1 - c * c)
    light, view = np.moveaxis([s * np.cos(azimuth), s * np.sin(azimuth), c], 0, -1)
    return light, view


def averages(parts: SurfaceParts, light: F64, view: F64, scatter: F64 = SCATTER, **maps: float) -> F64:
    """M (PAIRS,) of facets of the generator's BSDF that do not hide each other, with slopes of a
    t-distribution of two degrees of freedom about SLOPE."""
    random = np.random.default_rng(0)
    root = np.sqrt(random.exponential(size=FACETS))
    s = random.multivariate_normal(np.zeros(2), scatter, size=FACETS) / root[:, None] + SLOPE
    area = np.sqrt(1 + (s**2).sum(1))
    z = np.concatenate([-s, np.ones((FACETS, 1))], 1) / area[:, None]
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    frames = np.stack([x, np.cross(z, x), z], 1)
    # Directions in the frames of the facets, of which those that see neither light nor viewer do not count.
    i, o = (np.einsum("fkc,pc->pfk", frames, omega).reshape(-1, 3) for omega in (light, view))
    seen = (i[:, 2] > 1e-3) & (o[:, 2] > 1e-3)
    i[~seen], o[~seen] = (0, 0, 1), (0, 0, 1)
    value = np.array(point(parts, o, **maps).eval_pdf(vectors(i))[0])[0] * np.where(seen, o[:, 2], 0)
    reflected = (value.reshape(PAIRS, FACETS) * area).mean(1)
    facing = (np.maximum(view @ z.T, 0) * area).mean(1)
    return reflected / (light[:, 2] * facing)


def known(light: F64, view: F64, scatter: F64 = SCATTER, **maps: Any) -> F64:
    """Core (PAIRS,) of a known surface with the same slopes."""
    flat = geometry(LATTICE, np.zeros((4, 4), np.float32), slope=(float(SLOPE[0]), float(SLOPE[1])), **maps)
    surface = KnownSurface.of(flat, LATTICE, 0.0)
    levels = tuple(m.clone() for m in surface.maps)
    for m in levels:
        m[..., 2:5] += torch.from_numpy(scatter[[0, 0, 1], [0, 1, 1]])
    queries = [torch.from_numpy(a.astype(np.float32)) for a in (light, view)]
    u, sigma = torch.full((PAIRS, 2), 0.3), torch.full((PAIRS,), 0.1)
    found = compute_hints(replace(surface, maps=levels), *known_surface(1), None, u, sigma, *queries)
    return found[:, 4].double().numpy()


@pytest.mark.parametrize(("roughness", "weight"), [(0.2, 1.0), (0.3, 0.5)])
def test_the_coats_lobe(roughness: float, weight: float) -> None:
    """Of its own roughness about the slopes of the surface, where facets hide each other from the viewer
    alone."""
    light, view = pairs(0.4)
    wanted = averages(COAT, light, view, clearcoat=weight, clearcoat_roughness=roughness)
    found = known(light, view, color=(0.0, 0.0, 0.0), clearcoat=(weight, roughness))
    assert abs(found - wanted).sum() < 0.12 * wanted.sum()
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.05)


@pytest.mark.parametrize("metal", [False, True])
@pytest.mark.parametrize(
    ("scatter", "roughness", "tolerance"),
    [
        (SCATTER, 0.2, 0.03),
        (SCATTER, 0.7, 0.017),
        (1e-4 * np.eye(2), 0.1, 0.002),
        (1e-4 * np.eye(2), 0.4, 0.004),
    ],
)
def test_light_that_the_coat_transmits(metal: bool, scatter: F64, roughness: float, tolerance: float) -> None:
    """Share of the light of the layers below that is left. Facets beyond the horizon are not that exact."""
    light, view = pairs(0.25)
    below = SurfaceParts(specular=metal, metallic=metal)
    gloss = {"roughness": 0.4, "metallic": 1.0} if metal else {}
    layers = below, replace(below, clearcoat=True), COAT
    maps = {"base_color": 0.5, "clearcoat": 0.6, "clearcoat_roughness": roughness, **gloss}
    bare, coated, lobe = (averages(parts, light, view, scatter, **maps) for parts in layers)
    wanted = (coated - lobe) / bare
    gray, coat = {"color": (0.5,) * 3, **gloss}, {"clearcoat": (0.6, roughness)}
    options: list[dict[str, Any]] = [gray, gray | coat, {"color": (0.0,) * 3, **coat}]
    bare, coated, lobe = (known(light, view, scatter, **o) for o in options)
    found = (coated - lobe) / bare
    assert wanted.min() < 0.96
    assert np.quantile(abs(found / wanted - 1), 0.75) < tolerance


def test_a_coat_without_weight_changes_nothing() -> None:
    """Of a Lambert surface, also at grazing angles."""
    light, view = pairs(0.02)
    bare, coated = (known(light, view, **o) for o in ({}, {"clearcoat": (0.0, 0.3)}))
    np.testing.assert_allclose(coated, bare, rtol=1e-6)


def test_roughness_counts_where_there_is_a_coat() -> None:
    """Half of a tile has a smooth coat, the rest a rough one of no weight."""
    flat = geometry(LATTICE, np.zeros((4, 4), np.float32), clearcoat=(1.0, 0.3))
    weight, roughness = np.zeros((2, 8, 8), np.float32)
    weight[:, 2:6], roughness[:], roughness[:, 2:6] = 1.0, 0.9, 0.3
    given = replace(flat, clearcoat=weight, clearcoat_roughness=roughness)
    mean = KnownSurface.of(given, LATTICE, 0.0).maps[0][0, 0]
    assert float(mean[10]) == pytest.approx(0.5, abs=0.01)
    assert float(mean[11]) == pytest.approx(0.3**4, rel=0.2)
