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
from support.surfaces import point, vectors
from torch import Tensor

from mbtf_core.data.lattice import Lattice, sigma_of_level
from mbtf_fit.models.relief import known_surface
from mbtf_fit.native import library
from mbtf_fit.ops.constants import PLACES
from mbtf_fit.surface import hints
from mbtf_fit.surface.hints import compute_hints
from mbtf_fit.surface.known import KnownSurface
from mbtf_fit.surface.lookup import Packing, lookup
from mbtf_fit.surface.prefilter import lookup_sigma, prefilter
from mbtf_gen.render.bsdf.surface import SurfaceParts
from mbtf_gen.sampling.light_kernel import LightKernel

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


def hints_of(known: KnownSurface, *queries: Tensor, places: int, light_depth: float | None = None) -> Tensor:
    return compute_hints(known, *known_surface(places, light_depth), None, *queries)


def surface(**options: Any) -> KnownSurface:
    """A flat tile under a delta light."""
    return KnownSurface.of(geometry(LATTICE, np.zeros((8, 8), np.float32), **options), LATTICE, 0.0)


@pytest.mark.parametrize("places", [1, 2, 4, 16])
def test_a_flat_lambert_tile(places: int) -> None:
    found = hints_of(surface(), *queries(500), places=places)
    wanted = torch.tensor([0.0, 1.0, 0.0, 0.0, *(c / math.pi for c in (0.5, 0.4, 0.3))])
    torch.testing.assert_close(found, wanted.expand(500, 7), atol=1e-5, rtol=1e-5)


def conductor(alpha: tuple[float, float], light: Tensor, view: Tensor) -> np.ndarray:
    """BRDF (n,) of unmodified Mitsuba's GGX facets without Fresnel term, for directions (n, 3)."""
    description = {"type": "roughconductor", "distribution": "ggx", "material": "none"}
    bsdf = mi.load_dict({**description, "alpha_u": alpha[0], "alpha_v": alpha[1]})
    interaction = mi.SurfaceInteraction3f()
    interaction.wi, omega = (mi.Vector3f(w.numpy().T.copy()) for w in (light, view))
    return np.array(bsdf.eval(mi.BSDFContext(), interaction, omega))[0] / view[:, 2].numpy()


@pytest.mark.parametrize(
    ("slope", "roughness", "tolerance"), [((0, 0), 0.3, 3e-3), ((0, 0), 0.6, 3e-3), ((0.7, -0.4), 0.3, 0.02)]
)
@pytest.mark.parametrize("color", [(1.0, 0.8, 0.6), (0.02, 0.02, 0.02)])
def test_the_lobe_is_that_of_unmodified_mitsuba(
    slope: tuple[float, float],
    roughness: float,
    tolerance: float,
    color: tuple[float, float, float],
    compiled: bool,
) -> None:
    """Of a facet that is lit along its normal, where facets mask each other from the viewer alone. If it is
    tilted, microfacets face up from the plane instead of from itself. A metal reflects all light at grazing
    angles."""
    known = surface(color=color, roughness=roughness, metallic=1.0, slope=slope)
    u, sigma, view, _ = queries(300)
    normal = torch.nn.functional.normalize(torch.tensor([[-slope[0], -slope[1], 1.0]]), dim=1)
    light = normal.expand(300, 3).contiguous()
    seen = (view @ normal[0]) > 0.15
    found = hints_of(known, u, sigma, light, view, places=1)[seen, 4:]
    # The facet's own frame.
    x = torch.nn.functional.normalize(torch.linalg.cross(normal, torch.tensor([[0.3, 0.5, 0.1]])), dim=1)
    frame = torch.cat([x, torch.linalg.cross(normal, x), normal])
    alpha = roughness**2
    value = conductor((alpha, alpha), light[seen] @ frame.T, view[seen] @ frame.T)
    half = torch.nn.functional.normalize(light + view, dim=1)[seen]
    schlick = ((1 - (half * view[seen]).sum(1, keepdim=True)) ** 5).numpy()
    wanted = value[:, None] * (np.array(color) + (1 - np.array(color)) * schlick)
    np.testing.assert_allclose(found, wanted / float(normal[0, 2]), rtol=tolerance)


@pytest.mark.parametrize(
    ("roughness", "specular", "tolerance"),
    [(0.1, 0.5, 0.002), (0.3, 0.5, 0.006), (0.5, 0.1, 0.004), (0.5, 0.5, 0.008), (1.0, 0.5, 0.03)],
)
def test_a_dielectric_is_that_of_the_generator(
    roughness: float, specular: float, tolerance: float, compiled: bool
) -> None:
    """Its base scatters what its lobe leaves, and its facets shadow each other. One of F0 < 2% reflects
    50 F0 at grazing angles, which dark colors show."""
    color = (0.8, 0.3, 0.0)
    u, sigma, light, view = queries(4000)
    known = surface(color=color, roughness=roughness, specular=specular)
    found = hints_of(known, u, sigma, light, view, places=1)[:, 4:].numpy()
    base = np.tile(np.array(color)[:, None], (1, 4000))
    at = view.double().numpy()
    there = point(SurfaceParts(specular=True), at, base_color=base, specular=specular, roughness=roughness)
    wanted = (np.array(there.eval_pdf(vectors(light.numpy()))[0]) / light[:, 2].numpy()).T
    assert np.all(((found - wanted) ** 2).mean(0) < tolerance**2 * (wanted**2).mean(0))
    np.testing.assert_allclose(found.mean(0), wanted.mean(0), rtol=tolerance)


def test_scattered_slopes_are_anisotropic_facets(compiled: bool) -> None:
    """Mirrors whose slopes have a scatter are GGX facets of twice that scatter, which unmodified Mitsuba
    renders; the light is vertical, and facets mask each other from the viewer alone."""
    known = surface(color=(1.0, 1.0, 1.0), roughness=0.1, metallic=1.0)
    alpha, angle = np.array([0.5, 0.2]), 0.6
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    scatter = turn @ np.diag(alpha**2 / 2) @ turn.T
    maps = tuple(m.clone() for m in known.maps)
    for m in maps:
        m[..., 2:5] = torch.from_numpy(scatter[[0, 0, 1], [0, 1, 1]])
    u, sigma, view, _ = queries(300)
    light = torch.tensor([[0.0, 0.0, 1.0]]).expand(300, 3).contiguous()
    found = hints_of(replace(known, maps=maps), u, sigma, light, view, places=1)[:, 4]
    own = 1e-4  # of roughness 0.1: adds to α²
    along = torch.cat([view[:, :2] @ torch.from_numpy(turn).float(), view[:, 2:]], 1)
    wanted = conductor((*np.sqrt(alpha**2 + own),), light, along)
    np.testing.assert_allclose(found.numpy(), wanted, rtol=3e-3)


@pytest.mark.parametrize(
    ("width", "cosine", "roughness", "tolerance"),
    [
        (1, 0.95, 0.1, 0.02),
        (1, 0.5, 0.05, 0.05),
        (1, 0.15, 0.1, 0.09),
        (3, 0.5, 0.2, 0.04),
        (3, 0.3, 0.5, 0.04),
    ],
)
def test_the_lobe_is_averaged_over_the_light(
    width: float, cosine: float, roughness: float, tolerance: float
) -> None:
    """Means of unmodified Mitsuba's facets, whose masking and shadowing are correlated by height, over the
    generator's light. Half vectors are up to three standard deviations from the normal."""
    count, draws, kernel, random = 8, 40_000, LightKernel(width), np.random.default_rng(3)
    alpha, azimuth = roughness**2, np.linspace(0, 2 * np.pi, count, endpoint=False)
    distance = np.sqrt(alpha**2 / 2 + math.radians(width) ** 2 / 4) * np.resize([0.3, 1.0, 1.7, 3.0], count)
    half = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.ones(count)], 1)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    light = np.array([math.sqrt(1 - cosine**2), 0.0, cosine])
    view = 2 * (half @ light)[:, None] * half - light
    view = view[view[:, 2] > 0.1]
    drawn = kernel.sample(np.tile(light, (draws, 1)), random)
    up = np.maximum(drawn[:, 2], 1e-3)
    a, b = ((np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) / 2 for c in (up, view[:, 2:].clip(1e-3)))
    weight = np.where(drawn[:, 2] > 0, up, 0) * (1 + a) * (1 + b) / (1 + a + b) / kernel.irradiance(light)
    lights, views = (
        torch.from_numpy(a).float() for a in (np.tile(drawn, (len(view), 1)), view.repeat(draws, 0))
    )
    wanted = (conductor((alpha, alpha), lights, views).reshape(-1, draws) * weight).mean(1)
    flat = np.zeros((8, 8), np.float32)
    white = geometry(LATTICE, flat, color=(1.0, 1.0, 1.0), roughness=roughness, metallic=1.0)
    known = KnownSurface.of(white, LATTICE, width)
    u, sigma = torch.full((len(view), 2), 0.3), torch.full((len(view),), 0.1)
    at = torch.from_numpy(np.tile(light, (len(view), 1))).float(), torch.from_numpy(view).float()
    found = hints_of(known, u, sigma, *at, places=1)[:, 4].numpy()
    assert abs(found - wanted).sum() < tolerance * wanted.sum()
    np.testing.assert_allclose(found, wanted, rtol=0.4)


def test_scattered_slopes_are_lit_like_many_facets(compiled: bool) -> None:
    """Irradiance of slopes that are drawn from the distribution: means of max(0, n·ω_i) over their areas."""
    known = surface(slope=(0.3, -0.1))
    scatter = torch.tensor([[0.10, 0.06], [0.06, 0.20]])
    maps = tuple(m.clone() for m in known.maps)
    for m in maps:
        m[..., 2:5] += torch.tensor([scatter[0, 0], scatter[0, 1], scatter[1, 1]])
    u, sigma, light, view = queries(50)
    found = hints_of(replace(known, maps=maps), u, sigma, light, view, places=1)[:, 1]
    random = np.random.default_rng(0)
    # A t-distribution of two degrees of freedom: normal over the root of a mean of two squares.
    root = np.sqrt(random.exponential(size=400_000))
    s = random.multivariate_normal(np.zeros(2), scatter.numpy(), size=root.size) / root[:, None] + [0.3, -0.1]
    facing = np.maximum(0, light[:, 2:].numpy() - light[:, :2].numpy() @ s.T)
    upright = 1 / np.sqrt(1 + 0.3**2 + 0.1**2)
    np.testing.assert_allclose(found, upright * facing.mean(1) / light[:, 2].numpy(), rtol=0.02)


@pytest.mark.parametrize("size", [1e-30, 1e-6, 0.5, 10.0])
def test_footprints_beyond_the_levels_are_clamped(size: float, compiled: bool) -> None:
    known = rough_surface(LATTICE)
    u, _, light, view = queries(200)
    found, wanted = (
        hints_of(known, u, torch.full((200,), s), light, view, places=4)
        for s in (size, 0.5 if size > 0.1 else 0.5 * 2.0**-LATTICE.finest)
    )
    torch.testing.assert_close(found, wanted, atol=0, rtol=0)


def test_more_places_come_closer_to_the_mean_over_the_footprint() -> None:
    """Of 1000 view rays at Gaussian positions, shaded at the finest level."""
    lattice = Lattice(5)
    known, level = rough_surface(lattice), torch.full((300,), 3.5)
    sigma = torch.from_numpy(sigma_of_level(level.numpy())).float()
    u, _, light, view = queries(300, lattice)
    trace, shade = known_surface(16)
    everywhere = replace(trace, places=tuple(map(tuple, np.random.default_rng(0).normal(size=(1000, 2)))))
    _, hits, _ = known.intersections(everywhere, u, level, view)
    wanted = known.shading(replace(shade, finer=5.0), hits, level, light, view)
    errors = []
    for places in PLACES:
        found = hints_of(known, u, sigma, light, view, places=places)[:, 1:]
        errors.append(float((found - wanted).square().mean().sqrt()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.6 * errors[0]


@needs_kernel
@pytest.mark.parametrize(("glossy", "coated"), [(True, False), (False, False), (True, True)])
@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize(
    ("places", "light_depth"), [(1, None), (2, None), (4, None), (16, None), (1, 0.05), (16, 0.05)]
)
def test_kernel_and_pytorch_agree(
    glossy: bool, coated: bool, aspect: float, places: int, light_depth: float | None
) -> None:
    lattice = Lattice(3, aspect)
    known = rough_surface(lattice, glossy=glossy, coated=coated)
    u, sigma, light, view = queries(3000, lattice)
    u, sigma = 5 * u - 2, 1.5 * sigma
    found = hints_of(known, u, sigma, light, view, places=places, light_depth=light_depth)
    level = (-torch.log2(2 * sigma)).clamp(0, 3)
    trace, shade = known_surface(places, light_depth)
    height, hits, depths = known.intersections(trace, u, level, view)
    wanted = torch.cat([height, known.shading(shade, hits, level, light, view, depths)], 1)
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


@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
def test_light_in_a_groove_weakens_below_the_ray_past_its_ridge(azimuth: float, compiled: bool) -> None:
    """Of a V-groove of depth 0.2 across the light, whose sides have the slope 0.4: the ray of slope 0.3 past
    the ridge at 0 meets the far side at x with ``-0.3 x = 0.4 (x - 1)``. Horizons, 0 here, know of none."""
    size, depth = 64, 0.5
    across = torch.arange(size) / size
    profile = -0.4 * torch.minimum(across, 1 - across)
    # Row 0 is the side v → 1, vertices are at texel centers.
    along_v = azimuth in (90.0, 270.0)
    heights = profile.flip(0)[:, None].expand(size, size) if along_v else profile.expand(size, size)
    known = replace(surface(), heights=heights.contiguous())
    # Distance from the ridge that the light passes.
    x = torch.linspace(0.02, 0.98, 49)
    position = ((x if azimuth >= 180.0 else 1.0 - x) + 0.5 / size) % 1.0
    other = torch.full_like(position, 0.3)
    u = torch.stack([other, position] if along_v else [position, other], 1)
    angle = math.radians(azimuth)
    light = torch.tensor([math.cos(angle), math.sin(angle), 0.3])
    light = torch.nn.functional.normalize(light, dim=0).expand(49, 3).contiguous()
    view = torch.tensor([[0.0, 0.0, 1.0]]).expand(49, 3).contiguous()
    sigma = torch.full((49,), 0.5 * 2.0**-LATTICE.finest)
    found = hints_of(known, u, sigma, light, view, places=1, light_depth=depth)[:, 1]
    # A ray that is a below the ridge at 0 enters beyond it, at x' with ``-a - 0.3 x' = 0.4 x'``.
    z = -0.4 * torch.minimum(x, 1 - x)
    at_ridge = z + 0.3 * x
    first = torch.where(at_ridge < 0, at_ridge * 4 / 7, z)
    wanted = 0.5 + 0.5 * torch.exp(-(first - z) / (light[:, 2] * depth))
    torch.testing.assert_close(found, wanted, atol=2e-3, rtol=0)
    assert 15 < (wanted == 1.0).sum() < 25


def test_far_tiles_look_like_the_first_one(compiled: bool) -> None:
    """Also where rays to the light magnify the rounding of positions, which are exact here."""
    known = rough_surface(LATTICE)
    u, sigma, light, view = queries(1000)
    u = (1024 * u).round() / 1024
    near, far = (hints_of(known, u + n, sigma, light, view, places=4, light_depth=0.003) for n in (0, 512))
    torch.testing.assert_close(near, far, atol=0, rtol=0)


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
    found = known.visibility(known_surface(1)[1], u, None, torch.full((n,), level), light)[:, 0]
    assert 0.2 < wanted.mean() < 0.8
    assert float(found.mean()) == pytest.approx(float(wanted.mean()), abs=0.05)
    assert float((found - wanted).square().mean()) < 0.25 * float(wanted.var())


@pytest.mark.parametrize(("given", "shape"), [((12, 16), (12, 16)), ((15, 9), (8, 6)), ((6, 8), (20, 31))])
@pytest.mark.parametrize("wave", [(0, 1), (2, 0), (1, -2)])
def test_a_wave_keeps_its_phase_and_the_gaussian_share_of_its_amplitude(
    given: tuple[int, int], shape: tuple[int, int], wave: tuple[int, int]
) -> None:
    aspect, sigma = 0.75, 0.08

    def cosine(rows: int, columns: int) -> np.ndarray:
        j, i = (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns
        return np.cos(2 * np.pi * (wave[0] * j[:, None] + wave[1] * i) + 0.4)

    found = prefilter(torch.from_numpy(cosine(*given))[..., None], shape, sigma, aspect)[..., 0]
    share = np.exp(-2 * (np.pi * sigma) ** 2 * ((wave[0] / aspect) ** 2 + wave[1] ** 2))
    np.testing.assert_allclose(found, share * cosine(*shape), atol=2e-6)


def test_lookups_are_gaussian_averages_wherever_they_fall() -> None:
    """Direct sums over a random map, at the centers and the corners of texels of two levels. Textures of
    twice the texels of a level have little error of interpolation."""
    size, lattice = 64, Lattice(3)
    image = np.random.default_rng(0).random((size, size, 1)).astype(np.float32)
    levels = [
        prefilter(torch.from_numpy(image), Lattice(4).shape(s + 1), lookup_sigma(s, 2 ** (s + 1)), 1.0)
        for s in range(lattice.finest + 1)
    ]
    table = torch.cat([level.flatten(0, 1) for level in levels])
    packing = Packing.of(Lattice(4), range(1, 5))
    center = (np.arange(size) + 0.5) / size
    for level in (2, 3):
        u = np.random.default_rng(1).random((300, 2))
        u[:100] = (np.floor(u[:100] * 2**level) + 0.5) / 2**level
        u[100:200] = np.floor(u[100:200] * 2**level) / 2**level
        found = lookup(table, packing, torch.from_numpy(u).float(), torch.full((300,), float(level)))
        weights = []
        for x, cells in ((u[:, 1], 1 - center), (u[:, 0], center)):
            d = (x[:, None] - cells + 0.5) % 1 - 0.5
            w = sum(np.exp(-0.5 * ((d + k) / sigma_of_level(level)) ** 2) for k in (-1, 0, 1))
            weights.append(w / w.sum(1, keepdims=True))
        wanted = np.einsum("nj,ni,ji->n", *weights, image[..., 0])
        error = found[:, 0].numpy() - wanted
        assert np.sqrt((error**2).mean()) < 0.15 * wanted.std()
        for part in (slice(0, 100), slice(100, 200)):
            assert found[part, 0].numpy().std() == pytest.approx(wanted[part].std(), rel=0.1)
