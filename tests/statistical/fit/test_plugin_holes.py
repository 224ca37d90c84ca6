"""Holes of a fitted material: transmitted light, shadows, and no light counted twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fit_data import random_queries
from support.plugin_materials import write_material
from support.plugin_scenes import interaction, plane
from support.scenes import mi

from mbtf_core.data.lattice import Lattice
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.material.transmittance import Transmittance

GRAY, SHARE = 0.1, 0.35


def even(finest: int = 2) -> Transmittance:
    """Constant transmittance."""
    levels = []
    for s in range(finest + 1):
        texels = np.zeros((2**s, 2**s, 6), np.float32)
        texels[..., 0] = SHARE
        levels.append(texels)
    return Transmittance(Lattice(finest), (0.0,), [levels])


@pytest.fixture(scope="module", params=["neumip", "relief"])
def lace(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A gray material with partial transmittance."""
    folder = tmp_path_factory.mktemp("lace")
    options = {"constant": (GRAY,) * 3, "finest": 2, "transmittance": even(), "sampled": True}
    write_material(folder, model=request.param, **options)
    return {"type": "mbtf", "material": str(folder), "networks": "cooperative", "sampling": "cosine"}


def render(
    integrator: str, elevation: float, spp: int = 256, seed: int = 0, depth: int = 6, **scene: Any
) -> float:
    """Mean of a small picture that looks at the origin."""
    z, x = np.sin(np.radians(elevation)), np.cos(np.radians(elevation))
    sensor = {
        "type": "perspective",
        "fov": 4,
        "to_world": mi.ScalarTransform4f().look_at([8 * float(x), 0, 8 * float(z)], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgb"},
    }
    # Merged shapes would leave the scene's bounds, which distant lights start from.
    loaded = mi.load_dict({"type": "scene", "sensor": sensor, **scene}, optimize=False)
    tracer = mi.load_dict({"type": integrator, "max_depth": depth})
    return float(np.array(mi.render(loaded, integrator=tracer, spp=spp, seed=seed), np.float64).mean())


def test_the_plugin_evaluates_the_fitted_transmittance(tmp_path: Path) -> None:
    """Against NumPy, at all levels, seams and views, from both sides."""
    random = np.random.default_rng(2)
    lattice = Lattice(3, 2.0)
    layers = [
        [random.normal(0.15, 0.1, (*lattice.shape(s), 6)).astype(np.float32) for s in range(4)]
        for _ in range(2)
    ]
    model = Transmittance(lattice, (-0.05, -0.2), layers)
    write_material(tmp_path, finest=3, aspect=2.0, transmittance=model)
    evaluator = Evaluator(read_material(tmp_path), "cooperative")
    q = random_queries(random, 3000, lattice)
    grazing = 0.02 + 0.08 * random.random(300)
    q["omega_o"][:300] = np.stack([np.sqrt(1 - grazing**2), 0 * grazing, grazing], -1)
    u, view = mi.Point2f(q["u"].T * 3 - 1), mi.Vector3f(q["omega_o"].T)
    level = evaluator.level(mi.Float(q["sigma"]))
    wanted = model.evaluate(q["u"] * 3 - 1, q["sigma"], q["omega_o"])
    assert 0.05 < wanted.mean() < 0.95
    np.testing.assert_allclose(np.array(evaluator.transmittance(u, level, view)), wanted, atol=2e-4)
    np.testing.assert_allclose(np.array(evaluator.transmittance(u, level, -view)), wanted, atol=2e-4)


def test_rays_to_and_fro_pass_the_same_holes(tmp_path: Path) -> None:
    """Those of a two-sided surface are slanted alike for both of its sides."""
    random = np.random.default_rng(2)
    lattice = Lattice(2)
    levels = [random.normal(0.3, 0.2, (*lattice.shape(s), 6)).astype(np.float32) for s in range(3)]
    write_material(tmp_path, finest=2, transmittance=Transmittance(lattice, (-0.1,), [levels]))
    own = {"material": str(tmp_path), "networks": "cooperative", "sampling": "cosine", "two_sided": True}
    bsdf = mi.load_dict({"type": "mbtf", **own})
    there, back = (
        interaction(64, (x, 2 * x, z), uv=mi.Point2f(0.3, 0.6)) for x, z in ((0.3, 0.5), (-0.3, -0.5))
    )
    passed = [np.array(bsdf.eval_null_transmission(si)) for si in (there, back)]
    assert 0.05 < passed[0].mean() < 0.95
    np.testing.assert_allclose(*passed, rtol=1e-5)


@pytest.mark.parametrize("lace", ["neumip"], indirect=True)
@pytest.mark.parametrize("integrator", ["path", "mbtf_path"])
@pytest.mark.parametrize(
    ("elevation", "two_sided", "reflected"),
    [(50.0, False, np.pi * GRAY), (-50.0, False, 0.0), (-50.0, True, np.pi * GRAY)],
)
def test_a_sheet_in_a_furnace_conserves_energy(
    integrator: str, elevation: float, two_sided: bool, reflected: float, lace: dict[str, Any]
) -> None:
    """From below it transmits as much as from above, and reflects nothing unless it is two-sided."""
    seen = render(integrator, elevation, m=plane(lace | {"two_sided": two_sided}), e={"type": "constant"})
    assert seen == pytest.approx(reflected + SHARE, abs=0.012)


@pytest.mark.parametrize("lace", ["relief"], indirect=True)
def test_light_reaches_surfaces_below_holes(lace: dict[str, Any]) -> None:
    """A point light, two sheets above each other, and the ground visible through neither."""
    sheets = {}
    for k, z in enumerate((3.0, 3.5)):
        to_world = mi.ScalarTransform4f().translate([3.0 * z / 4.0, 0, z]).scale(1.0)
        sheets[f"sheet{k}"] = {"type": "rectangle", "to_world": to_world, "b": lace}
    ground = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(0.6), "b": {"type": "diffuse"}}
    lamp = {"type": "directional", "direction": [-0.6, 0.0, -0.8], "irradiance": 1.0}
    seen = render("mbtf_path", 150.0, depth=2, g=ground, e=lamp, **sheets)
    bare = render("mbtf_path", 150.0, depth=2, g=ground, e=lamp)
    assert bare == pytest.approx(0.5 * 0.8 / np.pi, rel=1e-3)
    assert seen / bare == pytest.approx(SHARE**2, rel=1e-3)


@pytest.mark.parametrize("lace", ["relief"], indirect=True)
@pytest.mark.parametrize("integrator", ["path", "mbtf_path"])
@pytest.mark.parametrize("kind", ["mbtf", "mask"])
def test_emitters_behind_holes_are_counted_once(integrator: str, kind: str, lace: dict[str, Any]) -> None:
    """Ground below a wide sheet below a sky. In ``mbtf_path`` emitter sampling and the path's own directions
    share the light; Mitsuba's shadow rays end at the sheet."""
    mask = {"type": "mask", "opacity": 1.0 - SHARE, "b": {"type": "diffuse", "reflectance": 0.0}}
    sheet = {
        "type": "rectangle",
        # Above the camera.
        "to_world": mi.ScalarTransform4f().translate([0, 0, 20]).scale(4000.0),
        "b": lace if kind == "mbtf" else mask,
    }
    ground = {"type": "rectangle", "b": {"type": "diffuse", "reflectance": 0.8}}
    seen = render(integrator, 80.0, g=ground, s=sheet, e={"type": "constant"})
    assert seen == pytest.approx(0.8 * SHARE, abs=0.006)


def test_transmitted_and_reflected_samples_have_the_stated_density(lace: dict[str, Any]) -> None:
    bsdf = mi.load_dict(lace | {"sampling": "network"})
    n = 50_000
    partials = {"dp_du": mi.Vector3f(1, 0, 0), "dp_dv": mi.Vector3f(0, -1, 0)}
    pixel = {"duv_dx": mi.Vector2f(0.2, 0), "duv_dy": mi.Vector2f(0, 0.2)}
    si = interaction(n, (0.3, 0.2, 0.8), **partials, **pixel)
    random = np.random.default_rng(5).random((3, n)).astype(np.float32)
    choice, xi = mi.Float(random[0]), mi.Point2f(random[1:])
    context = mi.BSDFContext()
    bs, weight = bsdf.sample(context, si, choice, xi)
    null = np.array(bs.sampled_type) == int(mi.BSDFFlags.Null)
    assert null.mean() == pytest.approx(SHARE, abs=0.01)
    np.testing.assert_allclose(
        np.array(bs.wo)[:, null].T, np.tile(-np.array(si.wi).T[:1], (null.sum(), 1)), atol=1e-6
    )
    np.testing.assert_allclose(np.array(weight)[:, null], 1.0)
    value, pdf = bsdf.eval_pdf(context, si, bs.wo)
    kept = ~null & (np.array(bs.pdf) > 0)
    np.testing.assert_allclose(np.array(pdf)[kept], np.array(bs.pdf)[kept], rtol=1e-3)
    ratio = np.array(value)[:, kept] / np.array(pdf)[kept]
    np.testing.assert_allclose(np.array(weight)[:, kept], ratio, rtol=1e-3)
    # All of the light is found by either kind of direction alone.
    alone = mi.BSDFContext()
    alone.type_mask = int(mi.BSDFFlags.GlossyReflection)
    reflected = float(np.array(bsdf.sample(alone, si, choice, xi)[1]).mean())
    assert float(np.array(weight).mean()) == pytest.approx(reflected + SHARE, abs=0.01)
    np.testing.assert_allclose(np.array(bsdf.eval_null_transmission(si))[0], SHARE, rtol=1e-5)
