"""The surface is sampled with its stated density and weights: χ² tests, and Mitsuba's ``path``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from mitsuba.python.chi2 import ChiSquareTest
from numpy.typing import NDArray
from support.mitsuba_blocks import GRIDS, block, mitsuba_halves, random_queries
from support.scenes import LightKernel, Transport, direction, directional, estimate, mi
from support.significance import aggregate_test
from support.surfaces import ALL, point, sobol, towards

from mbtf_core.stats import elevation_groups
from mbtf_gen.render.bsdf.surface import SurfaceParts

DIFFUSE = SurfaceParts()
SPECULAR = SurfaceParts(specular=True)
METAL = SurfaceParts(specular=True, metallic=True)
COAT = SurfaceParts(clearcoat=True)
SHEEN = SurfaceParts(sheen=True)


def tilt(along_x: float, along_y: float) -> dict[str, Any]:
    """Map of constant residual slopes."""
    return {"slopes": [[along_x], [along_y], [0.0]]}


def sloping(parts: SurfaceParts) -> SurfaceParts:
    return replace(parts, slopes=True)


class Hemisphere:
    """Directions above the plane on [-1, 1]², sinh-spaced in both angles around a lobe of a given width."""

    def __init__(self, center: NDArray[np.float64], width: float) -> None:
        self.theta = float(np.arccos(np.clip(center[2], -1.0, 1.0)))
        self.phi = float(np.arctan2(center[1], center[0]))
        self.width = width
        self.turn = float(width / max(np.sin(self.theta), width / 3.0))
        self.turns = float(np.arcsinh(np.pi / self.turn))
        self.low = float(np.arcsinh(-self.theta / width))
        self.high = float(np.arcsinh((np.pi / 2 - self.theta) / width))

    def bounds(self) -> Any:
        return mi.ScalarBoundingBox2f([-1, self.low], [1, self.high])

    def aspect(self) -> float:
        return 1.0

    def map_forward(self, p: Any) -> Any:
        theta = dr.clip(self.theta + self.width * dr.sinh(p.y), 0.0, 0.5 * np.pi)
        phi = self.phi + self.turn * dr.sinh(p.x * self.turns)
        s, c = dr.sincos(theta)
        return mi.Vector3f(s * dr.cos(phi), s * dr.sin(phi), c)

    def map_backward(self, w: Any) -> Any:
        phi = dr.atan2(w.y, w.x) - self.phi
        phi -= 2 * np.pi * dr.round(phi / (2 * np.pi))
        theta = dr.acos(dr.clip(w.z, -1.0, 1.0))
        return mi.Point2f(dr.asinh(phi / self.turn) / self.turns, dr.asinh((theta - self.theta) / self.width))

    def density(self, w: Any) -> Any:
        """Solid angle over area of the square, at directions."""
        p = self.map_backward(w)
        sine = dr.safe_sqrt((1.0 - w.z) * (1.0 + w.z))
        return sine * self.width * dr.cosh(p.y) * self.turn * self.turns * dr.cosh(p.x * self.turns)


def chi_square(parts: SurfaceParts, wi: NDArray[np.float64], maps: dict[str, Any]) -> ChiSquareTest:
    """The test, run, of sampling a surface towards `wi`."""
    widths = [maps.get("roughness", 0.3) ** 2] if parts.specular or parts.metallic else [1.0]
    if parts.clearcoat:
        widths.append(maps.get("clearcoat_roughness", 0.3) ** 2)
    slope = maps["slopes"] if parts.slopes else [[0.0], [0.0]]
    normal = np.array([-slope[0][0], -slope[1][0], 1.0])
    normal /= np.linalg.norm(normal)
    domain = Hemisphere(2 * (wi @ normal) * normal - wi, min(1.0, 2.0 * min(widths)))

    def draw(xi: Any) -> tuple[Any, Any]:
        surface = point(parts, np.tile(wi, (dr.width(xi), 1)), **maps)
        omega, weight, _ = surface.sample(xi.x, mi.Point2f(xi.y, xi.z))
        kept = dr.max(weight) > 0
        return dr.select(kept, omega, mi.Vector3f(0, 0, 1)), dr.select(kept, mi.Float(1.0), 0.0)

    def pdf(omega: Any) -> Any:
        surface = point(parts, np.tile(wi, (dr.width(omega), 1)), **maps)
        return surface.eval_pdf(omega)[1] * domain.density(omega)

    # The light that metal scatters several times lies along the horizon, far from a narrow lobe's cells.
    fine = 48 if parts.metallic and widths[0] < 0.05 else 16
    test = ChiSquareTest(domain, draw, pdf, sample_dim=3, sample_count=400_000, res=41, ires=fine, seed=7)
    test.run(significance_level=0.01, test_count=len(CASES), quiet=True)
    return test


VIEWS = {"above": towards(1.0), "oblique": towards(0.6, 40), "grazing": towards(0.08, 200)}
CASES: list[tuple[str, SurfaceParts, dict[str, Any]]] = [
    ("diffuse", DIFFUSE, {}),
    ("diffuse tilted", sloping(DIFFUSE), tilt(0.5, -0.3)),
    *((f"specular {r}", SPECULAR, {"roughness": r}) for r in (0.05, 0.2, 0.5, 1.0)),
    ("specular tilted", sloping(SPECULAR), {"roughness": 0.3, **tilt(-0.4, 0.2)}),
    *((f"metal {r}", METAL, {"roughness": r, "metallic": 1.0}) for r in (0.1, 0.3, 1.0)),
    ("dark metal", METAL, {"roughness": 0.6, "metallic": 1.0, "base_color": 0.2}),
    ("half metal tilted", sloping(METAL), {"roughness": 0.4, "metallic": 0.5, **tilt(0.3, 0.3)}),
    ("clearcoat", COAT, {"clearcoat_roughness": 0.2}),
    *((f"sheen {r}", SHEEN, {"sheen_roughness": r, "base_color": 0.6}) for r in (0.07, 0.3, 1.0)),
    ("sheen tilted", sloping(SHEEN), {"sheen": 0.5, **tilt(0.4, 0.2)}),
    ("everything", ALL, {"roughness": 0.5, "clearcoat_roughness": 0.1, "metallic": 0.4, "base_color": 0.7}),
]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("case", CASES, ids=lambda c: c[0].replace(" ", "-"))
def test_samples_have_the_stated_density(case: tuple[str, SurfaceParts, dict[str, Any]], view: str) -> None:
    test = chi_square(case[1], VIEWS[view], case[2])
    assert not test.fail, test.messages
    assert p_value(test) > 1 - (1 - 0.01) ** (1 / (len(CASES) * len(VIEWS))), test.messages


def p_value(test: ChiSquareTest) -> float:
    return float(np.array(test.p_value).ravel()[0])


@pytest.mark.parametrize("case", CASES, ids=lambda c: c[0].replace(" ", "-"))
def test_weights_are_value_over_density(case: tuple[str, SurfaceParts, dict[str, Any]]) -> None:
    """Also through the registered plugin, which Mitsuba's integrators call with local directions."""
    name, parts, maps = case
    xi = sobol(1 << 12, 3)
    for wi in VIEWS.values():
        surface = point(parts, np.tile(wi, (len(xi), 1)), **maps)
        omega, weight, pdf = surface.sample(mi.Float(xi[:, 0]), mi.Point2f(xi[:, 1:].T))
        value, density = surface.eval_pdf(omega)
        w, f, p, q = (np.array(v, np.float64) for v in (weight.x, value.x, pdf, density))
        kept = w > 0
        assert kept.mean() > 0.4
        # A direction of single precision next to a narrow lobe's edge has no more digits.
        w, f, p, q = (x[kept] for x in (w, f, p, q))
        np.testing.assert_allclose(q, p, rtol=2e-2)
        np.testing.assert_allclose(w, f / p, rtol=2e-2)
        assert np.median(np.abs(w * p / f - 1)) < 1e-5
        assert w.max() < 12, name


def plugin(**values: Any) -> dict[str, Any]:
    """``mbtf_surface`` with numbers for parameters; the base color is an RGB triple."""
    base = {"type": "rgb", "value": list(values.pop("base_color", (0.8, 0.7, 0.6)))}
    return {"type": "mbtf_surface", "base_color": base, **values}


def test_plugin_answers_as_the_surface_does() -> None:
    shared = {"roughness": 0.4, "metallic": 0.3, "specular": 0.6, "clearcoat": 0.5, "sheen": 0.4}
    bsdf = mi.load_dict(plugin(base_color=(0.7, 0.7, 0.7), **shared))
    xi = sobol(1 << 10, 3)
    wi = towards(0.5, 30)
    rest = {"clearcoat_roughness": 0.1, "sheen_roughness": 0.3}
    surface = point(ALL, np.tile(wi, (len(xi), 1)), base_color=0.7, **shared, **rest)
    si = dr.zeros(mi.SurfaceInteraction3f, len(xi))
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f(*map(float, wi))
    chosen, at = mi.Float(xi[:, 0]), mi.Point2f(xi[:, 1:].T)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, chosen, at)
    omega, expected, pdf = surface.sample(chosen, at)
    np.testing.assert_allclose(np.array(weight), np.array(expected), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(np.array(bs.pdf), np.array(pdf), rtol=1e-5)
    np.testing.assert_allclose(np.array(si.to_world(bs.wo)), np.array(omega), atol=1e-6)
    value, density = bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo)
    np.testing.assert_allclose(np.array(value), np.array(surface.eval_pdf(omega)[0]), rtol=2e-3, atol=1e-6)
    np.testing.assert_allclose(np.array(density), np.array(surface.eval_pdf(omega)[1]), rtol=2e-3, atol=1e-6)


def test_mitsuba_agrees_on_glossy_metal(tmp_path: Path) -> None:
    """The plugin under ``mi.render`` and Mitsuba's ``path``, over a block of tiles, against the own loop."""
    grid = GRIDS["square"]
    omega_i = direction(50, 70)
    bsdf = plugin(roughness=0.45, metallic=1.0)
    q = random_queries(4096, 0.3, omega_i)
    a, b = mitsuba_halves(block(grid, bsdf, tmp_path), directional(omega_i), q, grid.aspect, 5)
    transport = Transport(max_depth=4, roulette_depth=1000)
    ours = estimate(grid, bsdf, LightKernel(0.0), q, 32, transport=transport, seed=5)
    groups = elevation_groups(q.omega_o, edges=(0.0, 0.8, 1.0))
    result = aggregate_test(ours.value_a, ours.value_b, a, b, groups)
    # As for a Lambert surface: light that slips past shadow edges, up to a thousandth of the mean.
    mean = float(ours.value_a.mean())
    allowed = {"mean": 1e-3 * mean, "scatter": 1e-3 * mean**2}
    for c in result.comparisons:
        assert c.corrected > 1e-3 or abs(c.estimate.value) < allowed[c.kind], str(result)
    assert mean > 0.02
