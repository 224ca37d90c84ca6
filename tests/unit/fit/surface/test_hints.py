"""Hints of a known surface: closed forms, brute force, and the kernel against PyTorch."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from support.fit_data import random_queries
from support.known_surfaces import geometry, rough_heights, rough_surface
from support.scenes import mi
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_fit.models.relief import known_surface
from mbtf_fit.native import library
from mbtf_fit.surface import hints
from mbtf_fit.surface.hints import compute_hints
from mbtf_fit.surface.known import KnownSurface

LATTICE = Lattice(3)
needs_kernel = pytest.mark.skipif(library.kernel() is None, reason=library.missing_reason() or "kernel")


def queries(n: int, lattice: Lattice = LATTICE, seed: int = 0) -> list[Tensor]:
    arrays = random_queries(np.random.default_rng(seed), n, lattice)
    return [torch.from_numpy(arrays[name]) for name in ("u", "sigma", "omega_i", "omega_o")]


@pytest.fixture(params=[pytest.param(True, marks=needs_kernel), False], ids=["kernel", "pytorch"])
def compiled(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """With and without the kernel."""
    if not request.param:
        monkeypatch.setattr(hints, "kernel", lambda: None)
    return bool(request.param)


def hints_of(known: KnownSurface, *queries: Tensor, places: int) -> Tensor:
    return compute_hints(known, *known_surface(places), *queries)


def surface(**options: Any) -> KnownSurface:
    """A flat tile under a delta light."""
    return KnownSurface.of(geometry(LATTICE, np.zeros((8, 8), np.float32), **options), LATTICE, 0.0)


@pytest.mark.parametrize("places", [1, 2, 4])
def test_a_flat_lambert_tile(places: int) -> None:
    found = hints_of(surface(), *queries(500), places=places)
    wanted = torch.tensor([0.0, 1.0, 0.0, 0.0, *(c / math.pi for c in (0.5, 0.4, 0.3))])
    torch.testing.assert_close(found, wanted.expand(500, 7), atol=1e-5, rtol=1e-5)


def test_a_tilted_facet_gets_its_cosine() -> None:
    u, sigma, light, view = queries(500)
    found = hints_of(surface(slope=(0.5, -0.2)), u, sigma, light, view, places=1)
    normal = torch.tensor([-0.5, 0.2, 1.0]) / math.sqrt(1 + 0.5**2 + 0.2**2)
    wanted = (light @ normal).clamp_min(0) / light[:, 2]
    torch.testing.assert_close(found[:, 1], wanted, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(found[:, 2:4], normal[:2].expand(500, 2), atol=1e-5, rtol=0)


@pytest.mark.parametrize("roughness", [0.3, 0.6])
@pytest.mark.parametrize("metallic", [1.0, 0.0])
def test_the_lobe_is_that_of_unmodified_mitsuba(roughness: float, metallic: float, compiled: bool) -> None:
    """Against `roughconductor` without Fresnel term, seen from above: there joint and separate masking by
    facets agree. Light and view may be exchanged."""
    color = (1.0, 0.8, 0.6)
    known = surface(color=color, roughness=roughness, metallic=metallic)
    u, sigma, light, _ = queries(300)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(300, 3)
    found = hints_of(known, u, sigma, light, up, places=1)
    description = {"type": "roughconductor", "alpha": roughness**2, "distribution": "ggx", "material": "none"}
    conductor = mi.load_dict(description)
    interaction = mi.SurfaceInteraction3f()
    interaction.wi = mi.Vector3f(0, 0, 1)
    omega = mi.Vector3f(light.numpy().T.copy())
    value = np.array(conductor.eval(mi.BSDFContext(), interaction, omega))[0] / light[:, 2].numpy()
    half = torch.nn.functional.normalize(light + up, dim=1)
    schlick = ((1 - half[:, 2:]) ** 5).numpy()
    f0 = np.array(color) if metallic else np.full(3, 0.04)
    wanted = value[:, None] * (f0 + (1 - f0) * schlick)
    if not metallic:
        wanted += np.array(color) / np.pi
    np.testing.assert_allclose(found[:, 4:], wanted, rtol=2e-3)
    exchanged = hints_of(known, u, sigma, up, light, places=1)
    torch.testing.assert_close(exchanged[:, 4:], found[:, 4:], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("size", [1e-30, 1e-6, 0.5, 10.0])
def test_footprints_beyond_the_levels_are_clamped(size: float, compiled: bool) -> None:
    known = rough_surface(LATTICE)
    u, _, light, view = queries(200)
    found, wanted = (
        hints_of(known, u, torch.full((200,), s), light, view, places=4)
        for s in (size, 0.5 if size > 0.1 else 0.5 * 2.0**-LATTICE.finest)
    )
    torch.testing.assert_close(found, wanted, atol=0, rtol=0)


def test_a_smooth_mirror_of_facets_keeps_the_energy() -> None:
    """White metal facets of α = 0.09 reflect 99 % of the light from above."""
    n = 400
    cosine, azimuth = (np.arange(n) + 0.5) / n, 2 * np.pi * (np.arange(16) + 0.5) / 16
    c, a = (x.ravel() for x in np.meshgrid(cosine, azimuth))
    s = np.sqrt(1 - c * c)
    light = torch.from_numpy(np.stack([s * np.cos(a), s * np.sin(a), c], -1).astype(np.float32))
    view = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(light), 3)
    white = surface(color=(1.0, 1.0, 1.0), roughness=0.3, metallic=1.0)
    u, sigma = torch.full((len(light), 2), 0.3), torch.full((len(light),), 0.1)
    core = hints_of(white, u, sigma, light, view, places=1)[:, 4].numpy()
    # ∫ f cos dω: means over cosine and azimuth times 2π.
    assert 2 * np.pi * (core * c).mean() == pytest.approx(0.99, abs=0.01)


@needs_kernel
@pytest.mark.parametrize("glossy", [True, False])
@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize("places", [1, 2, 4])
def test_kernel_and_pytorch_agree(glossy: bool, aspect: float, places: int) -> None:
    lattice = Lattice(3, aspect)
    known = rough_surface(lattice, glossy=glossy)
    u, sigma, light, view = queries(3000, lattice)
    u, sigma = 5 * u - 2, 1.5 * sigma
    found = hints_of(known, u, sigma, light, view, places=places)
    level = (-torch.log2(2 * sigma)).clamp(0, 3)
    trace, shade = known_surface(places)
    height, hits = known.intersections(trace, u, level, view)
    wanted = torch.cat([height, known.shading(shade, hits, level, light, view)], 1)
    scale = wanted.abs().mean(0)
    assert float(((found - wanted).abs() / (scale + wanted.abs())).quantile(0.999)) < 1e-4


@pytest.mark.parametrize(
    ("elevation", "wanted"),
    [(0.0, 0.0), (0.4, 0.158655), (0.5, 0.5), (0.6, 0.841345), (0.7, 0.977250), (1.2, 1.0)],
)
def test_visibility_is_the_normal_distribution_of_the_horizon(
    elevation: float, wanted: float, compiled: bool
) -> None:
    """Of mean 0.5 and standard deviation 0.1 at the azimuth 3.25 of 16: 0 below all horizons, 1 above.
    Lights at azimuths that are not between 3 and 4 are hidden."""
    count = 16
    mean, square = torch.full((count,), 1.5), torch.full((count,), 2.25)
    # Linear between azimuths: 3/4 of the third, 1/4 of the fourth.
    mean[3:5] = torch.tensor([0.45, 0.65])
    square[3:5] = torch.tensor([0.23, 0.35])
    horizon = torch.cat([mean, square])
    flat = surface()
    known = replace(flat, horizons=tuple(h * 0 + horizon for h in flat.horizons))
    azimuth = 2 * math.pi / count * torch.tensor([3.25, 1.0, 8.5, 15.9])
    light = torch.stack(
        [math.cos(elevation) * azimuth.cos(), math.cos(elevation) * azimuth.sin(), azimuth * 0], 1
    )
    light[:, 2] = max(1e-4, math.sin(elevation))
    u, sigma, _, view = queries(4)
    # Irradiance of a flat tile: the visible share.
    found = hints_of(known, u, sigma, light, view, places=1)[:, 1]
    torch.testing.assert_close(found, torch.tensor([wanted, 0.0, 0.0, 0.0]), atol=2e-4, rtol=0)


@pytest.mark.parametrize("level", [2.0, 4.0])
def test_visibility_is_that_of_shadow_rays(level: float) -> None:
    """Shares of Gaussian footprints that see the light: by many shadow rays, and by the filtered horizon."""
    lattice = Lattice(5)
    heights = rough_heights(64, 64, depth=0.35, seed=3)
    known = KnownSurface.of(geometry(lattice, heights), lattice, 1.0)
    random = np.random.default_rng(0)
    n, samples = 150, 200
    u, _, light, _ = queries(n, lattice, seed=5)
    light = torch.nn.functional.normalize(light * torch.tensor([1.0, 1.0, 0.5]), dim=1)
    spread = 0.5 * 2**-level * random.standard_normal((n, samples, 2))
    at = (u[:, None] + torch.from_numpy(spread).float()).reshape(-1, 2)
    up = torch.tensor([0.0, 0.0, 1.0]).expand(len(at), 3).contiguous()
    z = known.tracer.trace(at, up)
    to_light = light[:, None].expand(n, samples, 3).reshape(-1, 3).contiguous()
    # Where the ray towards the light passes the reference plane: seen from there, the point is the first hit.
    above = at - z[:, None] / to_light[:, 2:] * to_light[:, :2]
    lit = (known.tracer.trace(above, to_light) - z).abs() < 1e-4
    wanted = lit.view(n, samples).float().mean(1)
    found = known.visibility(known_surface(1)[1], u, torch.full((n,), level), light)[:, 0]
    assert 0.2 < wanted.mean() < 0.8
    assert float(found.mean()) == pytest.approx(float(wanted.mean()), abs=0.05)
    assert float((found - wanted).square().mean()) < 0.25 * float(wanted.var())


def test_a_surface_survives_its_tensors() -> None:
    known = rough_surface(LATTICE)
    again = KnownSurface.from_tensors(known.tensors(), LATTICE)
    arrays = queries(200)
    torch.testing.assert_close(
        hints_of(again, *arrays, places=4), hints_of(known, *arrays, places=4), atol=0, rtol=0
    )
