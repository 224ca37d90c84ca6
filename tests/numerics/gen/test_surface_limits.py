"""The surface at its limits, on a plane: mirrors, grazing views, clipped values, NaN, shading normals."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from support.scenes import direction, estimate, flat, mi, queries
from support.surfaces import point, towards, vectors

from mbtf_core.errors import PartialError
from mbtf_gen.render.bsdf.microfacet import half_tangent2, smith
from mbtf_gen.render.bsdf.surface import SurfaceParts
from mbtf_gen.sampling.light_kernel import LightKernel

Array = NDArray[np.float64]
GOLD = np.array([0.9, 0.6, 0.3])


def bitmap(pixels: ArrayLike, filter_type: str = "bilinear") -> dict[str, Any]:
    array = np.ascontiguousarray(pixels, np.float32)
    image = mi.Bitmap(array[..., None] if array.ndim == 2 else array)
    more = {"raw": True, "filter_type": filter_type, "wrap_mode": "repeat"}
    return {"type": "bitmap", "bitmap": image, **more}


def surface(color: ArrayLike = 1.0, **values: Any) -> dict[str, Any]:
    """``mbtf_surface`` of a color and numbers or textures."""
    base = [float(c) for c in np.broadcast_to(np.asarray(color, np.float64), 3)]
    return {"type": "mbtf_surface", "base_color": {"type": "rgb", "value": base}, **values}


def values(
    bsdf: dict[str, Any], light: LightKernel | None, omega_i: Array, omega_o: Array, spp: int = 64
) -> Array:
    """M (n, 3) of a homogeneous plane."""
    n = max(np.atleast_2d(omega_i).shape[0], np.atleast_2d(omega_o).shape[0])
    e = estimate(flat(), bsdf, light, queries([0.5, 0.5], 0.1, omega_i, omega_o, n), spp)
    return 0.5 * (e.value_a + e.value_b).astype(np.float64)


def mirrored(w: Array) -> Array:
    return w * [-1, -1, 1]


@pytest.mark.parametrize("width", [0.05, 1.0, 10.0])
@pytest.mark.parametrize("roughness", [0.0, 0.003])
def test_mirror_under_a_lobe_shows_the_lobe(width: float, roughness: float) -> None:
    """M = F(μo) · L(ωo mirrored): every path is exact."""
    light = LightKernel(width)
    rng = np.random.default_rng(2)
    omega_o = towards(np.array([0.99, 0.7, 0.3, 0.1, 1e-2, 1e-3]).repeat(20), 360 * rng.random(120))
    omega_i = mirrored(omega_o) + np.radians(width) * rng.normal(size=omega_o.shape)
    omega_i[:, 2] = np.maximum(np.abs(omega_i[:, 2]), 1e-3)
    omega_i = (omega_i / np.linalg.norm(omega_i, axis=1, keepdims=True)).astype(np.float32).astype(np.float64)
    omega_o = omega_o.astype(np.float32).astype(np.float64)
    fresnel = GOLD + (1 - GOLD) * (1 - omega_o[:, 2:]) ** 5
    expected = fresnel * light.radiance(mirrored(omega_o), omega_i)[:, None]
    got = values(surface(GOLD, roughness=roughness, metallic=1.0), light, omega_i, omega_o, 2)
    # Single precision of a direction against a narrow lobe: 1e-7 rad of 1e-3 rad, and as much again.
    np.testing.assert_allclose(got, expected, rtol=2e-3 if width < 0.1 else 2e-4, atol=1e-5)


def test_polished_dielectric_mirrors_and_scatters_the_rest() -> None:
    """Mirror of F0 = 4% over a base of 0.5: both terms in closed form, with the Fresnel reflectance as E."""
    light = LightKernel(1.0)
    omega_o = towards(np.array([0.9, 0.5, 0.15]), 30.0)
    omega_i = mirrored(omega_o)

    def fresnel(c: Array) -> Array:
        return 0.04 + 0.96 * (1 - c) ** 5

    left_mean = 1 - (0.04 + 0.96 / 21)
    # The light's cone is so narrow that (1-E) is that of its axis, but for curvature.
    diffuse = 0.5 / np.pi * (1 - fresnel(omega_o[:, 2])) * (1 - fresnel(omega_i[:, 2])) / left_mean
    expected = fresnel(omega_o[:, 2]) * light.radiance(mirrored(omega_o), omega_i) + diffuse
    got = values(surface(0.5, roughness=0.0, specular=0.5), light, omega_i, omega_o, 1 << 16)[:, 0]
    np.testing.assert_allclose(got, expected, rtol=0.01)
    aside = values(surface(0.5, roughness=0.0, specular=0.5), light, direction(40, 200), omega_o, 1 << 13)[
        :, 0
    ]
    incoming = 1 - fresnel(np.sin(np.radians(40)))
    np.testing.assert_allclose(
        aside, 0.5 / np.pi * (1 - fresnel(omega_o[:, 2])) * incoming / left_mean, rtol=2e-3
    )


@pytest.mark.parametrize("kind", ["metallic", "specular", "clearcoat"])
@pytest.mark.parametrize("width", [0.05, 0.2, 1.0])
def test_value_is_continuous_from_a_mirror_on(kind: str, width: float) -> None:
    """The mirror is below a roughness of 0.00316; seen where it reflects a light narrower than the sun."""
    light = LightKernel(width)
    omega_o = towards(np.array([0.95, 0.5, 0.2, 0.05]), 10.0)
    omega_i = mirrored(omega_o)
    seen = []
    for r in (0.0, 0.00315, 0.00318):
        own = {"clearcoat": 1.0, "clearcoat_roughness": r}
        given = own if kind == "clearcoat" else {kind: 1.0, "roughness": r}
        seen.append(values(surface(0.5, **given), light, omega_i, omega_o, 1 << 16)[:, 0])
    for a, b in itertools.pairwise(seen):
        np.testing.assert_allclose(a, b, rtol=0.006)


def smeared(alpha: float, light: LightKernel, omega_i: Array, cosine: float) -> float:
    """White metal at the mirrored direction by quadrature over facet slopes; narrow lobes need no masking."""
    x, w = np.polynomial.legendre.leggauss(120)
    t, phi = np.meshgrid(0.5 * (x + 1), np.pi * (x + 1), indexing="ij")
    tangent = alpha * t / (1 - t)
    # D cosθ dω of facets within tangent: α² 2T dT dφ/2π / (α² + T²)².
    share = np.outer(0.5 * w, np.pi * w) * alpha**2 * tangent / (np.pi * (alpha**2 + tangent**2) ** 2)
    share *= alpha / (1 - t) ** 2
    h = np.stack([tangent * np.cos(phi), tangent * np.sin(phi), np.ones_like(t)], axis=-1)
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    wi = towards(cosine)
    d = h @ wi
    wo = 2 * d[..., None] * h - wi
    # D cosθ dω (wi·h)/(μi h.z): the projected area of facets that the viewer sees.
    seen = share * np.maximum(d, 0) / (cosine * h[..., 2]) * (wo[..., 2] > 0)
    arriving = light.radiance(wo.reshape(-1, 3), np.broadcast_to(omega_i, (wo.size // 3, 3)))
    return float(np.sum(seen.ravel() * arriving))


@pytest.mark.parametrize("alpha", [1.1e-5, 4e-5, 3e-4])
@pytest.mark.parametrize("cosine", [0.9, 0.4, 0.1])
def test_narrow_lobes_keep_their_digits(alpha: float, cosine: float) -> None:
    """Metal far smoother than the width of the light, down to the mirror threshold, in single precision."""
    light = LightKernel(0.05)
    omega_o = towards(cosine)
    omega_i = mirrored(omega_o)
    got = values(surface(1.0, metallic=1.0, roughness=alpha**0.5), light, omega_i, omega_o, 1 << 14)[0, 0]
    assert got == pytest.approx(smeared(alpha, light, omega_i, cosine), rel=6e-3)


@pytest.mark.parametrize("cosine", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_grazing_views_of_white_surfaces_keep_all_light(cosine: float, metallic: float) -> None:
    """White furnace: 1 at every view, within the 2e-3 of the energy tables."""
    for r in (0.0, 0.0033, 0.012, 0.03, 0.1, 0.5, 1.0):
        bsdf = surface(1.0, roughness=r, metallic=metallic, specular=0.5)
        got = values(bsdf, None, np.array([0.0, 0, 1]), towards(cosine), 1 << 16)
        np.testing.assert_allclose(got, 1.0, atol=5e-3)


def test_grazing_light_and_view_give_finite_values() -> None:
    omega = towards(np.array([1.0, 1e-2, 1e-4, 1e-6]))
    omega_i, omega_o = np.repeat(omega, 4, axis=0), mirrored(np.tile(omega, (4, 1)))
    for width in (0.0, 1.0):
        for r in (0.0, 0.02, 0.5):
            bsdf = surface(0.8, roughness=r, metallic=0.5, specular=0.5, clearcoat=0.5)
            e = estimate(flat(), bsdf, LightKernel(width), queries([0.5, 0.5], 0.1, omega_i, omega_o, 16), 64)
            assert np.all(np.isfinite(e.value_a))
            assert np.all(e.value_a >= 0)
            assert e.nonfinite == 0


@pytest.mark.parametrize("name", ["roughness", "clearcoat_roughness"])
def test_roughness_outside_its_range_is_clipped(name: str) -> None:
    given = {"metallic": 1.0} if name == "roughness" else {"clearcoat": 1.0}
    for out, limit in ((-1e-3, 0.0), (1.001, 1.0)):
        bsdfs = (surface(0.5, **given, **{name: bitmap(np.full((2, 2), x))}) for x in (out, limit))
        a, b = (values(bsdf, LightKernel(2.0), direction(50, 0), direction(50, 180)) for bsdf in bsdfs)
        np.testing.assert_allclose(a, b, rtol=1e-6)


# Every parameter as a map, so that all cases share their kernels.
NUMBERS = {"roughness": 0.3, "metallic": 0.5, "specular": 0.5, "clearcoat": 0.5, "clearcoat_roughness": 0.2}
NUMBERS |= {"sheen": 0.5, "sheen_roughness": 0.3}
MAPS = {name: np.full((2, 2), value) for name, value in NUMBERS.items()}
MAPS |= {name: np.full((2, 2, 3), 0.5) for name in ("base_color", "sheen_color")}
MAPS["slopes"] = np.zeros((2, 2, 3))
LIGHTS = (LightKernel(1.0), None)


# Every map under one light, one map under every light, and the maps of a Lambert surface.
@pytest.mark.parametrize(
    ("name", "light", "roles"),
    [
        *((name, LightKernel(1.0), list(MAPS)) for name in MAPS),
        *(("roughness", light, list(MAPS)) for light in (LightKernel(0.0), None)),
        *((n, light, ["base_color", "slopes"]) for n in ("base_color", "slopes") for light in LIGHTS),
    ],
)
def test_nan_in_a_map_is_reported_never_black(name: str, light: LightKernel | None, roles: list[str]) -> None:
    maps = {role: bitmap(MAPS[role] * (np.nan if role == name else 1.0)) for role in roles}
    with pytest.raises(PartialError, match="NaN or infinite"):
        values({"type": "mbtf_surface", **maps}, light, direction(50, 0), direction(60, 90))


def slopes(along_x: ArrayLike, along_y: ArrayLike) -> dict[str, Any]:
    """Map of residual slopes without interpolation, so that slopes may be discontinuous at creases."""
    x, y = np.broadcast_arrays(np.asarray(along_x, np.float64), np.asarray(along_y, np.float64))
    stacked = np.stack([x, y, 0 * x], axis=-1)
    return bitmap(np.broadcast_to(stacked, (2, 2, 3)) if x.ndim == 0 else stacked, "nearest")


@pytest.mark.parametrize("slope", [(0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.7, -1.1), (3.0, 0.0)])
@pytest.mark.parametrize("light", [(70, 0), (30, 90), (20, 200), (5, 320)])
def test_slopes_tilt_the_normal_of_a_plane(slope: tuple[float, float], light: tuple[float, float]) -> None:
    """A height that rises along +u (+v) has its normal towards -u (-v): albedo/π · max(0, n·ωi)/ωi,z."""
    omega_i = direction(*light)
    n = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    got = values(surface(0.6, slopes=slopes(*slope)), LightKernel(0.0), omega_i, direction(90, 0))
    np.testing.assert_allclose(got, 0.6 / np.pi * max(0.0, n @ omega_i) / omega_i[2], rtol=1e-4, atol=1e-7)


def test_what_lies_behind_the_face_or_the_shading_plane_is_black() -> None:
    """A normal tilted towards +x by 45°: light from below the face or behind the shading plane gives zero."""
    parts = SurfaceParts(specular=True, slopes=True)
    lights = np.array([[0.9, 0, -0.2], [-0.9, 0, 0.2], [0.9, 0, 0.2], [0, 0, 1]])
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    tilt = np.array([[-1.0], [0.0], [0.0]])
    for view, lit in ((towards(0.8), [False, False, True, True]), (-towards(0.8), [False] * 4)):
        value, pdf = point(parts, np.tile(view, (4, 1)), slopes=tilt).eval_pdf(vectors(lights))
        assert list(np.array(value.x) > 0) == lit
        assert list(np.array(pdf) > 0) == lit


@pytest.mark.parametrize("view", [(90, 0), (30, 0), (30, 180), (3, 0), (3, 180)])
@pytest.mark.parametrize("metallic", [None, 1.0])
def test_a_normal_map_makes_no_energy(view: tuple[float, float], metallic: float | None) -> None:
    """White furnace: light below the shading horizon or behind the face is lost; energy is never created."""
    given = {} if metallic is None else {"metallic": metallic, "roughness": 0.4}
    for slope in (0.2, 2.0, -2.0):
        bsdf = surface(1.0, slopes=slopes(slope, 0.0), **given)
        got = values(bsdf, None, np.array([0.0, 0, 1]), direction(*view), 1 << 14)
        assert got.max() < 1 + 3e-3
        assert got.min() > 0.05


@pytest.mark.parametrize("alpha", [1e-5, 1e-2, 0.3, 1.0])
def test_masking_keeps_its_digits(alpha: float) -> None:
    cosine = np.array([1 - 1e-6, 0.9, 0.1, 1e-3, 1e-6])
    x = alpha**2 * (1 - cosine**2) / cosine**2
    expected = 0.5 * np.expm1(0.5 * np.log1p(x))
    np.testing.assert_allclose(np.array(smith(mi.Float(cosine), alpha)), expected, rtol=5e-2, atol=0)
    np.testing.assert_allclose(np.array(smith(mi.Float(cosine[1:]), alpha)), expected[1:], rtol=1e-5)


@pytest.mark.parametrize("cosine", [0.9999, 0.7, 0.1, 1e-2])
def test_half_vectors_keep_the_digits_of_narrow_lobes(cosine: float) -> None:
    """The last digit of single precision; across the plane of incidence, that over the cosine."""
    rng = np.random.default_rng(5)
    n = 2000
    slope = 1e-5 * rng.normal(size=(n, 2))
    slope[n // 2 :, 1] = 0
    h = np.column_stack([slope, np.ones(n)]) / np.sqrt(1 + np.sum(slope**2, axis=1))[:, None]
    wi = np.array([np.sqrt(1 - cosine**2), 0.0, cosine]).astype(np.float32).astype(np.float64)
    wi /= np.linalg.norm(wi)
    wo = 2 * (h @ wi)[:, None] * h - wi
    found = np.array(half_tangent2(vectors(np.tile(wi, (n, 1))), vectors(wo)), np.float64)
    error = np.abs(np.sqrt(found) - np.linalg.norm(slope, axis=1))
    assert error[n // 2 :].max() < 2.5e-7
    assert error.max() < 2.5e-7 + 1e-7 / cosine
