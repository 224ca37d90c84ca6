"""Directions sampled by the plugin follow its density, and estimates of reflected light are unbiased."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import torch
from support.chi_square import Cap, chi_square_test
from support.fit_data import random_directions
from support.plugin_materials import TRAINING, write_material
from support.plugin_scenes import interaction, plane
from support.scenes import mi
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_core.directions import from_projected_disk
from mbtf_core.stats import Estimate, t_test
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.mixture import Mixture, SlopeLobe
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.config import FitConfig
from mbtf_fit.material.material import export
from mbtf_fit.ops import Lobe, Lookup, Operation, Transform
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.training import sampler as training
from mbtf_gen.engine.types import Vector3f

COUNT = 32


def random_mixture(random: np.random.Generator, viewer: np.ndarray, width: int) -> Mixture:
    """A random mixture: any width, tilt, shear and weight."""
    l11, l22 = np.exp(random.uniform(np.log(0.05), np.log(1.0), 2))
    l21, x, y = random.normal(0, 0.3, 3)
    lanes = [mi.Float(np.full(width, v, np.float32)) for v in (l11, l21, l22, x, y)]
    view = mi.Vector3f(*(mi.Float(np.full(width, v, np.float32)) for v in viewer))
    return Mixture(SlopeLobe(*lanes), mi.Float(float(random.uniform(0, 0.9))), view)


def uniform(n: int, seed: int) -> tuple[Any, Any]:
    """(choice, point) of the unit cube."""
    xi = np.random.default_rng(seed).random((3, n)).astype(np.float32)
    return mi.Float(xi[0]), mi.Point2f(xi[1:])


def p_value(seed: int) -> float:
    """χ² of a random mixture's samples."""
    n = 40_000
    viewer = random_directions(np.random.default_rng(100 + seed), 1)[0]

    def mixture(width: int) -> Mixture:
        return random_mixture(np.random.default_rng(seed), viewer, width)

    wo = np.array(mixture(n).sample(*uniform(n, seed))).T

    def density(w: np.ndarray) -> np.ndarray:
        return np.array(mixture(len(w)).density(mi.Vector3f(w.T.astype(np.float32))), np.float64)

    return chi_square_test(wo, density, Cap(cos_min=0.0), bins=(20, 40)).p_value


def test_samples_have_the_stated_density() -> None:
    p = np.sort([p_value(seed) for seed in range(COUNT)])
    assert p[0] > 0.01 / COUNT, p
    assert np.median(p) > 0.1, p


def test_distillation_has_the_density_of_the_plugin() -> None:
    """Of random mixtures, and its own lights have the density that it states."""
    random = np.random.default_rng(0)
    outputs = torch.tensor(random.normal([-1, 0, -1, 0, 0, 0], 0.5, (8, 6)).astype(np.float32))
    views = torch.tensor(random_directions(random, 8)).float()[:, None]
    lobe, count = training.LightMixture.of(outputs), 1 << 14
    light, density = lobe.sample(views, count, torch.Generator().manual_seed(0))
    above = density > 0
    solid = torch.where(above, 1 / density, 0).double()
    deviation = (solid.mean(1) - 2 * np.pi) / (solid.std(1) / count**0.5)
    assert deviation.abs().max() < 4.5
    light = torch.where(above[..., None], light, views)
    x, wo = (np.repeat(a.numpy(), count, 0).T for a in (outputs, views[:, 0]))
    mixture = Mixture.of([mi.Float(v) for v in x], mi.Vector3f(wo))
    expected = np.array(mixture.density(mi.Vector3f(light.view(-1, 3).T.numpy())))
    np.testing.assert_allclose(lobe.density(light, views).flatten(), expected, rtol=2e-3)


# A tilted GGX surface: base color, F0, α², slopes.
BASE, F0, ALPHA, TILT = 0.05, 0.5, 0.15, (0.2, -0.1)


def distilled(
    folder: Path,
    texel: tuple[float, ...],
    *value: Operation,
    kind: type[NeuralMaterial] = NeuralMaterial,
    queries: int = 1 << 24,
) -> Evaluator:
    """A material of a constant texel, with its sampler."""
    model = kind(Lattice(1), [Lookup("texel", "u", "level", "map", len(texel)), *value])
    model.texture("map").texels.data[:] = torch.tensor(texel)
    sampler = training.distill(model, queries, 0.1, 0)
    stated = {"hash": "0" * 64, "min_cos": 0.1}
    export(model, FitConfig(), folder, data=stated, training=TRAINING, sampler=sampler)
    return Evaluator(read_material(folder), "cooperative")


def mixture_of(evaluator: Evaluator, view: Vector3f) -> Mixture:
    """Its density somewhere."""
    return evaluator.mixture(evaluator.stage1(mi.Point2f(0.3, 0.6), mi.Float(0.5), view), view)


def estimates(folder: Path, view: np.ndarray, sampling: str, n: int = 1 << 15) -> np.ndarray:
    """Estimates (n,) of the light that is reflected under a constant sky."""
    own = {"type": "mbtf", "material": str(folder), "networks": "cooperative", "sampling": sampling}
    si = interaction(n, tuple(map(float, view)), uv=mi.Point2f(0.3, 0.6))
    _, weight = mi.load_dict(own).sample(mi.BSDFContext(), si, *uniform(n, 5))
    return np.array(weight, np.float64).mean(0)


def test_the_sampler_of_a_known_surface(tmp_path: Path) -> None:
    """Its reflection has the slopes of the surface, no bias, and a variance far below that of the cosine."""
    texel = (BASE,) * 3 + (F0, ALPHA**2, *TILT)
    lobe = Lobe("value", "texel[0:3]", "texel[3:4]", "texel[4:5]", "texel[5:7]", "omega_i", "omega_o")
    evaluator = distilled(tmp_path, texel, lobe)
    for direction in from_projected_disk([[0.1, 0.0], [-0.4, 0.3], [0.2, -0.7]]):
        found = mixture_of(evaluator, mi.Vector3f(*map(float, direction))).lobe
        np.testing.assert_allclose([found.l11[0], found.l22[0]], ALPHA, rtol=0.3)
        np.testing.assert_allclose([found.x[0], found.y[0]], TILT, atol=0.06)
        both = [estimates(tmp_path, direction, sampling) for sampling in ("network", "cosine")]
        own, flat = (Estimate(x.mean(), x.std() / len(x) ** 0.5, len(x), len(x) - 1.0) for x in both)
        assert t_test(own, flat).p_value > 1e-3
        assert own.error < flat.error / 2


# Roughness of brushed metal along and across its grain.
GRAIN = (0.2, 0.03)


def brushed(light: Vector3f, view: Vector3f) -> np.ndarray:
    """Values of unmodified Mitsuba's, times the light's cosine (n, 3)."""
    own = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
    metal = mi.load_dict(own | dict(zip(("alpha_u", "alpha_v"), GRAIN, strict=True)))
    si = interaction(dr.width(light), (0.0, 0.0, 1.0))
    si.wi = view
    return np.array(metal.eval(mi.BSDFContext(), si, light)).T


class BrushedMetal(NeuralMaterial):
    def forward(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        directions = (mi.Vector3f(w.T.numpy()) for w in (omega_i, omega_o))
        return torch.from_numpy(brushed(*directions)) / omega_i[:, 2:]


def test_the_shortest_distillation_finds_an_anisotropic_highlight(tmp_path: Path) -> None:
    """Seen along the normal, light from half vectors of slope ``L t`` is reflected with nearly a density
    proportional to ``(1+|t|²)⁻²``. Integrated, the relative second moments are 1/(12ab) by the cosine, and
    ``(c²/3 + (a²+b²)/6 + (3a⁴+3b⁴+2a²b²)/(24c²)) / ab`` by isotropic facets of α = c, of which the least."""
    a2, b2 = np.square(GRAIN)
    ab, fourth = np.sqrt(a2 * b2), 3 * a2**2 + 3 * b2**2 + 2 * a2 * b2
    cosine, isotropic = 1 / (12 * ab), ((a2 + b2) / 6 + np.sqrt(fourth / 18)) / ab
    least = int(training.ROUNDS * training.LIGHTS * training.LEAST / training.SHARE)
    value, normal = Transform("value", "texel"), mi.Vector3f(0, 0, 1)
    evaluator = distilled(tmp_path, (1.0,) * 3, value, kind=BrushedMetal, queries=least)
    moments = []
    for mixture in (mixture_of(evaluator, normal), Mixture.cosine(normal)):
        light = mixture.sample(*uniform(1 << 15, 0))
        # Both are 0 below the surface.
        x = brushed(light, normal)[:, 0] / np.maximum(mixture.density(light), 1e-9)
        moments.append((x**2).mean() / x.mean() ** 2)
    assert moments[1] == pytest.approx(cosine, rel=0.15)
    assert moments[0] - 1 < (isotropic - 1) / 10, moments


def test_a_lambert_material_keeps_the_cosine(tmp_path: Path) -> None:
    distilled(tmp_path, (0.2,) * 3, Transform("value", "texel"))
    assert not read_material(tmp_path).sampler
    found = estimates(tmp_path, np.array([0.6, 0.0, 0.8]), "network")
    np.testing.assert_allclose(found, 0.2 * np.pi, rtol=1e-3)


@pytest.fixture(scope="module", params=["neumip", "relief"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("material")
    # The highlights of `relief` are those of the known surface.
    brightness = {"neumip": 0.5, "relief": 0.1}[request.param]
    shape = {"finest": 3, "aspect": 0.7, "contrast": 0.3, "brightness": brightness}
    write_material(out, model=request.param, sampled=True, **shape)
    return out


@pytest.mark.parametrize("side", [1, -1])
def test_weights_are_value_over_density_of_the_same_directions(side: int, folder: Path) -> None:
    """sample, eval, pdf and eval_pdf of the plugin agree, and its samples pass χ² through a turned frame, at
    the back of a two-sided surface too."""
    own = {"material": str(folder), "networks": "cooperative", "two_sided": side < 0}
    bsdf = mi.load_dict({"type": "mbtf", **own})
    n = 100_000
    partials = {"dp_du": mi.Vector3f(0.6, 0.8, 0), "dp_dv": mi.Vector3f(0.8, -0.3, 0)}
    pixel = {"duv_dx": mi.Vector2f(0.1, 0.02), "duv_dy": mi.Vector2f(0.01, 0.3)}
    si = interaction(n, (0.5, 0.4, side * 0.5), uv=mi.Point2f(0.3, 1.7), **partials, **pixel)
    context = mi.BSDFContext()
    bs, weight = bsdf.sample(context, si, *uniform(n, 3))
    kept = np.array(bs.pdf) > 0
    # A tilted lobe has samples below the surface.
    assert kept.mean() > 0.5
    value, pdf = bsdf.eval_pdf(context, si, bs.wo)
    np.testing.assert_allclose(np.array(pdf)[kept], np.array(bs.pdf)[kept], rtol=2e-3)
    np.testing.assert_allclose(np.array(bsdf.pdf(context, si, bs.wo)), np.array(pdf), rtol=1e-5)
    np.testing.assert_allclose(np.array(bsdf.eval(context, si, bs.wo)), np.array(value), rtol=1e-5)
    np.testing.assert_allclose(
        np.array(weight)[:, kept], (np.array(value) / np.array(pdf))[:, kept], rtol=5e-3, atol=1e-6
    )

    def density(w: np.ndarray) -> np.ndarray:
        hit = dr.gather(mi.SurfaceInteraction3f, si, dr.zeros(mi.UInt32, len(w)))
        return np.array(bsdf.pdf(context, hit, mi.Vector3f(w.T.astype(np.float32))), np.float64)

    wo = np.where(kept, np.array(bs.wo), np.array([[0.0], [0.0], [-side]])).T
    half = Cap((0.0, 0.0, side), cos_min=0.0)
    assert chi_square_test(wo, density, half, bins=(12, 24)).p_value > 1e-3


def film(size: int) -> dict[str, Any]:
    return {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb"}


def furnace(bsdf: dict[str, Any], integrator: str, seed: int, spp: int = 64) -> np.ndarray:
    """Pixels of a sphere under constant white light, where it is seen."""
    view = mi.ScalarTransform4f().look_at([3, 2, 4], [0, 0, 0], [0, 1, 0])
    to_world = view @ mi.ScalarTransform4f().scale(0.6)
    sensor = {"type": "orthographic", "to_world": to_world, "film": film(12)}
    ball = {"type": "sphere", "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "ball": ball, "light": {"type": "constant"}, "sensor": sensor})
    tracer = mi.load_dict({"type": integrator, "max_depth": 2})
    return np.array(mi.render(scene, integrator=tracer, spp=spp, seed=seed), np.float64)


def test_a_white_sphere_vanishes_in_a_furnace(tmp_path: Path) -> None:
    """A material of value 1/π everywhere, with every sampling method."""
    write_material(tmp_path, constant=(1 / np.pi,) * 3)
    material = {"type": "mbtf", "material": str(tmp_path), "networks": "cooperative"}
    seen = furnace(material, "mbtf_path", 0, 256)
    np.testing.assert_allclose(seen.mean((0, 1)), 1.0, atol=0.005)
    # Near the silhouette and in the middle alike.
    np.testing.assert_allclose(seen.mean(2)[5:7, 5:7].mean(), 1.0, atol=0.03)


@pytest.mark.parametrize(("model", "integrator"), [("neumip", "path"), ("relief", "mbtf_path")])
def test_a_constant_material_equals_mitsubas_diffuse(model: str, integrator: str, tmp_path: Path) -> None:
    """Several bounces between a sphere and a plane, under two kinds of light, by t-test over runs; Mitsuba's
    BSDF in Mitsuba's path tracer."""
    color = (0.2, 0.5, 0.8)
    write_material(tmp_path, model=model, constant=tuple(c / np.pi for c in color))
    ours = {"type": "mbtf", "material": str(tmp_path), "networks": "cooperative"}
    theirs = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}}
    lamp = {"type": "point", "position": [2, 1, 3], "intensity": 20.0}
    lights = {"lamp": lamp, "sky": {"type": "constant", "radiance": 0.3}}
    view = mi.ScalarTransform4f().look_at([1, -5, 3], [0, 0, 0.4], [0, 0, 1])
    sensor = {"type": "perspective", "fov": 35, "to_world": view, "film": film(24)}
    means = {}
    for name, bsdf, kind, first in (("ours", ours, integrator, 0), ("theirs", theirs, "path", 100)):
        tracer = mi.load_dict({"type": kind, "max_depth": 5})
        ball = {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.8, "bsdf": bsdf}
        entries = {"ground": plane(bsdf, half=3.0), "ball": ball, "sensor": sensor}
        scene = mi.load_dict({"type": "scene", **entries, **lights})
        runs = [np.array(mi.render(scene, integrator=tracer, spp=16, seed=first + k)) for k in range(8)]
        means[name] = np.array([run.mean((0, 1)) for run in runs], np.float64)
    for channel in range(3):
        estimates = [
            Estimate(float(x.mean()), float(x.std(ddof=1) / np.sqrt(len(x))), len(x), len(x) - 1.0)
            for x in (means["ours"][:, channel], means["theirs"][:, channel])
        ]
        assert t_test(*estimates).p_value > 1e-3, means
        assert estimates[0].error < 0.005 * estimates[0].value
