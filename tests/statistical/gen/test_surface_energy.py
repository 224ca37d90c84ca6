"""The surface conserves energy, is reciprocal, and agrees with published formulas where they apply."""

from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import mi
from support.surfaces import ALL, point, sobol, towards, vectors

from mbtf_gen.render.bsdf.surface import SurfaceParts

Array = NDArray[np.float64]
METAL = SurfaceParts(metallic=True)
GLOSSY = SurfaceParts(specular=True, metallic=True)
COATED = SurfaceParts(specular=True, metallic=True, clearcoat=True)

ROUGHNESS = (0.0, 0.0033, 0.005, 0.013, 0.02, 0.1, 0.3, 0.5, 1.0)
COSINES = (1.0, 0.5, 0.1, 1e-2, 1e-3, 1e-4)
# Interpolation of the energy tables is off by 8e-4 at most, the points of the integral by as much.
TOLERANCE = 2e-3


def albedos(rows: Array, parts: SurfaceParts, points: int = 1 << 12) -> tuple[Array, Array]:
    """(∫ f μo dωo, greatest sampling weight) of surfaces with the parameters and cosines of `rows`."""
    xi = sobol(points, 3, seed=11)
    energy, greatest = [], []
    for part in np.array_split(rows, max(1, len(rows) * points // (1 << 22))):
        names = ["roughness", "metallic", "specular", "clearcoat", "clearcoat_roughness", "base_color"]
        names += ["cosine", "sheen", "sheen_roughness"]
        lanes = {n: np.repeat(c, points) for n, c in zip(names, part.T, strict=False)}
        wi = towards(lanes.pop("cosine"))
        chosen, u, v = (mi.Float(np.tile(xi[:, k], len(part))) for k in range(3))
        weight = np.array(point(parts, wi, **lanes).sample(chosen, mi.Point2f(u, v))[1].x, np.float64)
        energy.append(weight.reshape(-1, points).mean(axis=1))
        greatest.append(weight.reshape(-1, points).max(axis=1))
    return np.concatenate(energy), np.concatenate(greatest)


def sweep(coat: tuple[float, ...]) -> Array:
    """Every combination of parameters."""
    grid = itertools.product(
        ROUGHNESS, (0.0, 0.5, 1.0), (0.0, 0.5, 1.0), coat, (0.0, 0.2), (0.0, 0.5, 1.0), COSINES
    )
    return np.array([g for g in grid if g[3] > 0 or g[4] == 0], np.float64)


def test_white_surfaces_return_what_they_receive() -> None:
    rows = sweep((0.0,))
    energy, greatest = albedos(rows, GLOSSY)
    assert energy.max() < 1 + TOLERANCE, rows[energy.argmax()]
    white = rows[:, 5] == 1
    off = np.abs(energy - 1) * white
    assert off.max() < TOLERANCE, rows[off.argmax()]
    # Black is black: nothing but the dielectric's lobe.
    black = (rows[:, 5] == 0) & ((rows[:, 1] == 1) | (rows[:, 2] == 0))
    assert energy[black].max() == 0
    # Gray loses.
    assert energy[rows[:, 5] == 0.5][:].min() < 0.5
    assert greatest.max() < 10


def test_coated_surfaces_return_at_most_what_they_receive() -> None:
    rows = sweep((0.5, 1.0))
    energy, greatest = albedos(rows, COATED, 1 << 11)
    assert energy.max() < 1 + TOLERANCE, rows[energy.argmax()]
    # A coat keeps light that tries to leave: of a mirror, whose light passes it twice alike, up to a quarter
    # where E_c = 1/2, for E_c + (1-E_c)² ≥ 3/4; of broad light seen from above no more than a tenth.
    white = rows[:, 5] == 1
    assert energy[white].min() > 0.75 - TOLERANCE
    assert energy[white & (rows[:, 6] == 1)].min() > 0.9
    assert greatest.max() < 10


def test_surfaces_under_sheen_return_at_most_what_they_receive() -> None:
    """For any base; a white one loses little."""
    binary = (0.0, 1.0)
    below = itertools.product((0.0, 0.4), binary, (0.0, 0.5), binary, (0.2,), binary)
    grid = itertools.product(below, COSINES, (1.0,), (0.07, 0.3, 1.0))
    rows = np.array([(*lower, *rest) for lower, *rest in grid], np.float64)
    energy, greatest = albedos(rows, ALL, 1 << 13)
    assert energy.max() < 1 + TOLERANCE, rows[energy.argmax()]
    assert greatest.max() < 12, rows[greatest.argmax()]
    # What is lost comes in steeply and would leave low, where sheen takes more: up to a seventh.
    lambert = (rows[:, 1] == 0) & (rows[:, 2] == 0) & (rows[:, 3] == 0)
    assert 0.85 < energy[lambert & (rows[:, 5] == 1)].min() < 0.99
    # At the horizon sheen of weight 1 returns everything by itself.
    black = lambert & (rows[:, 5] == 0) & (rows[:, 6] == 1e-4) & (rows[:, 7] == 1)
    assert energy[black].min() > 0.95


@pytest.mark.parametrize(
    ("roughness", "cosine"), [(0.1, 0.1), (0.1, 0.5), (0.3, 1e-2), (0.45, 1.0), (1.0, 0.1), (1.0, 0.5)]
)
def test_sheen_takes_from_the_base_what_it_reflects(roughness: float, cosine: float) -> None:
    """Against a quadrature of D of Estevez and Kulla 2017 with Smith masking."""
    x, w = np.polynomial.legendre.leggauss(160)
    t, phi = np.meshgrid(0.5 * (x + 1), 0.5 * np.pi * (x + 1), indexing="ij")
    mu = t**2
    measure = np.outer(0.5 * w, np.pi * w) * 2 * t * mu
    reflected = np.array([textbook_sheen(c, mu, phi, roughness) for c in (cosine,)])[0]
    share = float(np.sum(reflected * measure))
    nodes = t[::8, 0] ** 2
    shares = [float(np.sum(textbook_sheen(c, mu, phi, roughness) * measure)) for c in nodes]
    left = 1 - np.maximum(share, np.interp(t[:, 0] ** 2, nodes, shares))
    base = float(np.sum(left * 0.5 * w * 2 * t[:, 0] * 2 * t[:, 0] ** 2))
    rows = np.array([[0.5, 0, 0, 0, 0.3, b, cosine, 1.0, roughness] for b in (0.0, 0.5, 1.0)])
    energy, _ = albedos(rows, SurfaceParts(sheen=True), 1 << 15)
    np.testing.assert_allclose(energy, share + np.array([0.0, 0.5, 1.0]) * base, atol=4e-3)


def textbook_sheen(cosine: float, mu: Array, phi: Array, roughness: float) -> Array:
    """D G2/(4 μi μo) with Λ from its definition: facets' projected area over the plane's, less one."""
    n = 1 / roughness**2
    theta = (np.arange(1500) + 0.5) / 1500 * np.pi / 2
    around = (np.arange(128) + 0.5) / 128 * np.pi
    weight = (2 + n) / (2 * np.pi) * np.sin(theta) ** (n + 1) * (np.pi / 2 / 1500) * (2 * np.pi / 128)

    def area(c: Array) -> Array:
        s = np.sqrt(1 - c**2)
        facing = c[:, None, None] * np.cos(theta)[:, None] + s[:, None, None] * np.sin(theta)[
            :, None
        ] * np.cos(around)
        return np.asarray(np.maximum(facing, 0).sum(axis=2) @ weight)

    grid = np.sin(np.linspace(0, np.pi / 2, 40)) ** 2
    areas = area(grid)

    def capital_lambda(c: Any) -> Any:
        return np.interp(np.arcsin(np.sqrt(c)), np.linspace(0, np.pi / 2, 40), areas) / c - 1

    wi, wo = towards(cosine), towards(mu, np.degrees(phi))
    h = wi + wo
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    d = (2 + n) / (2 * np.pi) * (1 - h[..., 2] ** 2).clip(0) ** (n / 2)
    return np.asarray(d / (1 + capital_lambda(cosine) + capital_lambda(mu)) / (4 * cosine * mu))


def random_directions(n: int, seed: int, least: float = 1e-2) -> Array:
    rng = np.random.default_rng(seed)
    return towards(np.exp(rng.uniform(np.log(least), 0, n)), 360 * rng.random(n))


def brdf(parts: SurfaceParts, wi: Array, wo: Array, **maps: Any) -> Array:
    """f (n, 3) for pairs of directions."""
    value = np.array(point(parts, wi, **maps).eval_pdf(vectors(wo))[0], np.float64).T
    return value / wo[:, 2:]


@pytest.mark.parametrize("roughness", [0.05, 0.2, 0.6, 1.0])
@pytest.mark.parametrize(
    ("parts", "maps"),
    [
        (SurfaceParts(), {}),
        (SurfaceParts(specular=True), {}),
        (SurfaceParts(diffuse=False, specular=True), {}),
        (METAL, {"metallic": 1.0}),
        (GLOSSY, {"metallic": 0.4}),
        (SurfaceParts(clearcoat=True), {"clearcoat": 0.8}),
        (SurfaceParts(sheen=True), {"sheen": 0.8, "sheen_color": np.array([[1.0], [0.5], [0.2]])}),
        (ALL, {"metallic": 0.4, "clearcoat": 0.5, "sheen": 0.7}),
    ],
    ids=["diffuse", "dielectric", "lobe", "metal", "mixture", "clearcoat", "sheen", "all"],
)
def test_value_is_reciprocal(parts: SurfaceParts, maps: dict[str, Any], roughness: float) -> None:
    one, other = random_directions(4000, 1), random_directions(4000, 2)
    # Half of the pairs near the mirrored direction, where narrow lobes are.
    other[::2] = one[::2] * [-1, -1, 1] + 0.5 * roughness**2 * np.random.default_rng(3).normal(size=(2000, 3))
    other[:, 2] = np.maximum(np.abs(other[:, 2]), 1e-2)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    color = np.array([[0.9], [0.5], [0.1]])
    given = {"base_color": color, "roughness": roughness, "clearcoat_roughness": 0.7 * roughness, **maps}
    given["sheen_roughness"] = roughness
    there, back = brdf(parts, one, other, **given), brdf(parts, other, one, **given)
    np.testing.assert_allclose(there, back, rtol=1e-3, atol=1e-6)


def textbook_lobe(wi: Array, wo: Array, alpha: float, f0: float) -> Array:
    """F D G2/(4 μi μo): Walter et al. 2007, eq. 33; Heitz 2014, eq. 99; Schlick 1994."""
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    cos2 = h[..., 2] ** 2
    tan2 = (1 - cos2) / cos2
    d = 1 / (np.pi * alpha**2 * cos2**2 * (1 + tan2 / alpha**2) ** 2)

    def capital_lambda(c: Array) -> Array:
        return (np.sqrt(1 + alpha**2 * (1 - c**2) / c**2) - 1) / 2

    g = 1 / (1 + capital_lambda(wi[..., 2]) + capital_lambda(wo[..., 2]))
    f = f0 + (1 - f0) * (1 - np.sum(wi * h, axis=-1)) ** 5
    return f * d * g / (4 * wi[..., 2] * wo[..., 2])


@pytest.mark.parametrize("roughness", [0.05, 0.3, 0.8])
@pytest.mark.parametrize("specular", [0.5, 1.0])
def test_dielectric_lobe_is_that_of_the_textbook(roughness: float, specular: float) -> None:
    wi, wo = random_directions(2000, 4), random_directions(2000, 5)
    wo[::2] = wi[::2] * [-1, -1, 1]
    value = brdf(SurfaceParts(specular=True), wi, wo, base_color=0.0, roughness=roughness, specular=specular)
    expected = textbook_lobe(wi, wo, roughness**2, 0.08 * specular)
    np.testing.assert_allclose(value[:, 0], expected, rtol=2e-3, atol=1e-7)


@pytest.mark.parametrize("cosine", [1.0, 0.4, 0.1])
@pytest.mark.parametrize("roughness", [0.4, 0.9])
def test_diffuse_light_is_what_the_dielectric_lobe_leaves(roughness: float, cosine: float) -> None:
    """SciPy integrates the textbook lobe: E. A base of albedo ρ then returns ρ (1-E)."""
    from scipy.integrate import dblquad

    wi = towards(cosine)

    def integrand(phi: float, mu: float) -> float:
        wo = towards(mu, np.degrees(phi))
        return float(textbook_lobe(wi, wo, roughness**2, 0.04) * mu)

    share = 2 * dblquad(integrand, 1e-6, 1, 0, np.pi, epsabs=2e-5, epsrel=1e-4)[0]
    base = np.array([0.0, 0.5, 1.0])
    rows = np.column_stack([np.full(3, v) for v in (roughness, 0, 0.5, 0, 0)] + [base, np.full(3, cosine)])
    energy, _ = albedos(rows, SurfaceParts(specular=True), 1 << 15)
    np.testing.assert_allclose(energy, share + base * (1 - share), atol=1e-3)


def test_without_gloss_it_is_mitsubas_diffuse() -> None:
    wi, wo = random_directions(500, 6), random_directions(500, 7)
    value = brdf(SurfaceParts(), wi, wo, base_color=0.37)
    np.testing.assert_allclose(value, 0.37 / np.pi, rtol=1e-5)
    # Without specular reflectance the gloss is none, whatever the roughness.
    value = brdf(GLOSSY, wi, wo, base_color=0.37, specular=0.0, metallic=0.0, roughness=0.2)
    np.testing.assert_allclose(value, 0.37 / np.pi, rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.05, 0.1, 0.2, 0.3])
def test_narrow_metal_lobe_is_mitsubas_roughconductor(roughness: float) -> None:
    """At low roughness the masking model hardly matters (Mitsuba's G is a product)."""
    rng = np.random.default_rng(8)
    wi = towards(rng.uniform(0.5, 1, 2000), 360 * rng.random(2000))
    alpha = roughness**2
    h = np.column_stack([alpha * rng.normal(size=(2000, 2)), np.ones(2000)])
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    wo = 2 * np.sum(wi * h, axis=1, keepdims=True) * h - wi
    kept = wo[:, 2] > 0.4
    wi, wo = wi[kept], wo[kept]
    own = np.array(point(METAL, wi, metallic=1.0, roughness=roughness).eval_pdf(vectors(wo))[0].x, np.float64)
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi = vectors(wi)
    mitsuba = mi.load_dict(
        {"type": "roughconductor", "alpha": alpha, "distribution": "ggx", "material": "none"}
    )
    expected = np.array(mitsuba.eval(mi.BSDFContext(), si, vectors(wo)).x, np.float64)
    np.testing.assert_allclose(own, expected, rtol=3e-3, atol=3e-3 * expected.max())
    assert np.mean(np.abs(own / expected - 1)) < 3e-3


def test_metal_gives_back_what_one_scattering_loses() -> None:
    """Kulla and Conty 2017: of the energy lost at first, F̄ (F̄ Ā + F̄² (1-Ā) Ā + …) is returned."""
    roughness, cosine = 1.0, 0.7
    x, w = np.polynomial.legendre.leggauss(160)
    mu, phi = np.meshgrid(0.5 * (x + 1), 0.5 * np.pi * (x + 1), indexing="ij")
    measure = np.outer(0.5 * w, np.pi * w) * mu

    def reflected(c: float, f0: float) -> float:
        wo = towards(mu.ravel(), np.degrees(phi).ravel())
        return float(np.sum(textbook_lobe(towards(c)[None], wo, roughness**2, f0) * measure.ravel()))

    nodes, weights = np.polynomial.legendre.leggauss(24)
    mean = sum(wt * c * reflected(c, 1.0) for c, wt in zip(0.5 * (nodes + 1), weights, strict=True))
    base = np.array([0.2, 0.5, 0.8, 1.0])
    fresnel = base + (1 - base) / 21
    several = sum(fresnel**k * (1 - mean) ** (k - 2) * mean for k in range(2, 200))
    expected = [reflected(cosine, b) for b in base] + several * (1 - reflected(cosine, 1.0))
    rows = np.array([[roughness, 1.0, 0.0, 0.0, 0.0, b, cosine] for b in base])
    np.testing.assert_allclose(albedos(rows, METAL, 1 << 15)[0], expected, atol=TOLERANCE)
