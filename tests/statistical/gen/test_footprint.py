"""The Gaussian footprint: wrapped on the torus, isotropic at any aspect, independent of the paths."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from support.chi_square import Rectangle, chi_square_test
from support.scenes import (
    Estimator,
    LightKernel,
    Stream,
    Transport,
    build_scene,
    direction,
    flat,
    mi,
    queries,
)

from mbtf_core.pictures import Camera
from mbtf_core.stats import mean_estimate, mean_of_halves, t_test
from mbtf_gen.pictures.reference import _camera_rays
from mbtf_gen.render.scene import CLEARANCE, LONG_SIDE
from mbtf_gen.sampling.rng import Purpose, stream_key, stream_number
from mbtf_gen.sampling.sobol import sequence

N = 1 << 18
CENTER = np.array([0.9, 0.05])


def points(sigma: float, aspect: float) -> NDArray[np.float64]:
    """uv (N, 2) of sampled footprint points, not wrapped."""
    sensor = mi.load_dict({"type": "mbtf_queries", "aspect": aspect})
    sensor.set_queries(queries(CENTER, sigma, [0, 0, 1], [0, 0, 1], 1))
    key = stream_key(4, stream_number("test", 2, Purpose.FOOTPRINT))
    # The first point of many queries: points of one query are no independent sample.
    words = (mi.UInt32(key & 0xFFFFFFFF), mi.UInt32(key >> 32))
    xi = sequence(*words, dr.arange(mi.UInt32, N), 0).next_2d()
    return np.array(sensor.footprint(dr.zeros(mi.UInt32, N), xi), np.float64).T


@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize("sigma", [1e-3, 0.1, 3.0])
def test_points_have_the_mean_and_covariance_of_the_footprint(sigma: float, aspect: float) -> None:
    # Lengths in tile widths: on a tile half as high as wide, σ spans twice as much of v.
    x = (points(sigma, aspect) - CENTER) * (1.0, aspect) / sigma
    # Single precision places the center to 1e-8.
    allowed = 1e-7 / sigma
    for axis in (0, 1):
        mean = mean_estimate(x[:, axis])
        assert abs(mean.value) < 4 * mean.error + allowed
        assert t_test(mean_estimate(x[:, axis] ** 2), 1.0).p_value > 1e-3
        assert t_test(mean_estimate(x[:, axis] ** 4), 3.0).p_value > 1e-3
    assert t_test(mean_estimate(x[:, 0] * x[:, 1])).p_value > 1e-3


def wrapped(offset: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Density on the circle of length 1 of a Gaussian around 0, summed over its images."""
    images = offset[:, None] + np.arange(-30, 31)
    return np.exp(-0.5 * (images / sigma) ** 2).sum(axis=1) / (sigma * np.sqrt(2 * np.pi))


@pytest.mark.parametrize("aspect", [1.0, 0.5])
@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.5])
def test_on_the_torus_they_follow_the_wrapped_gaussian(sigma: float, aspect: float) -> None:
    p = points(sigma, aspect)

    def density(q: NDArray[np.float64]) -> NDArray[np.float64]:
        return wrapped(q[:, 0] - CENTER[0], sigma) * wrapped(q[:, 1] - CENTER[1], sigma / aspect)

    result = chi_square_test(p - np.floor(p), density, Rectangle(), (24, 24))
    assert result.p_value > 1e-3, str(result)


# Cells of a lattice of random numbers in [0, 1)²: moments come out to a few thousandths.
CELLS = 512
ASPECTS = [1.0, 0.5, 3.0]


def lattice() -> Any:
    """Random numbers (CELLS²) at the centers of a lattice."""
    y, x = np.divmod(np.arange(CELLS * CELLS), CELLS)
    return mi.Point2f((np.stack([x, y]).astype(np.float32) + 0.5) / CELLS)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_query_rays_pass_the_reference_plane_at_their_point(aspect: float) -> None:
    unit = LONG_SIDE / max(1.0, aspect)
    sensor = mi.load_dict({"type": "mbtf_queries", "unit": unit, "aspect": aspect, "start": CLEARANCE})
    omega_o = np.array([direction(80, 10), direction(20, 100), direction(3, 250)])
    sensor.set_queries(queries(0.0, 0.0, [0, 0, 1], omega_o, 3))
    u = np.array([[0.1, 0.9], [2.7, -1.4], [0.5, 0.01]])
    ray = sensor.ray(dr.arange(mi.UInt32, 3), mi.Point2f(u.T.astype(np.float32).copy()))
    o, d = np.array(ray.o, np.float64).T, np.array(ray.d, np.float64).T
    np.testing.assert_allclose(d, -omega_o, atol=1e-6)
    plane = o[:, :2] - d[:, :2] * o[:, 2:] / d[:, 2:]
    # The tile is centered on the origin.
    expected = (u % 1.0 - 0.5) * (unit, unit * aspect)
    np.testing.assert_allclose(plane, expected, atol=1e-4)


@pytest.mark.parametrize("aspect", ASPECTS)
def test_camera_rays_fill_the_pixel_that_its_query_states(aspect: float) -> None:
    camera = Camera(elevation=35, azimuth=20, tiles_across=0.4, rows=9, columns=11, field_of_view=2.0)
    q = camera.queries(np.array([0, 0, 1.0]), aspect)
    tile = build_scene(flat(aspect), {"type": "diffuse"})
    source = _camera_rays(camera, Estimator(tile, LightKernel(0.0), Transport()))
    source.set_queries(q.flat(), 40)
    pixel = 50
    # The tenth query of a batch that begins with number 40.
    point = source.footprint(dr.full(mi.UInt32, pixel - 40, CELLS * CELLS), lattice())
    u = np.array(point, np.float64).T
    middle = u.mean(axis=0) - q.u.reshape(-1, 2)[pixel]
    np.testing.assert_allclose(middle, np.round(middle), atol=2e-4)
    # σ of the query is the geometric mean of the two radii.
    spread = np.cov((u * (1.0, aspect)).T)
    assert np.linalg.det(spread) ** 0.25 == pytest.approx(q.sigma.ravel()[pixel], rel=2e-2)
    ray = source.ray(None, point)
    o, d = np.array(ray.o, np.float64).T, np.array(ray.d, np.float64).T
    np.testing.assert_allclose(d.mean(axis=0), -q.omega_o.reshape(-1, 3)[pixel], atol=2e-3)
    back = camera.position - np.column_stack([u * (1.0, aspect), np.zeros(len(u))])
    np.testing.assert_allclose(-d, back / np.linalg.norm(back, axis=1)[:, None], atol=1e-5)
    plane = o[:, :2] - d[:, :2] * o[:, 2:] / d[:, 2:]
    expected = (u % 1.0 - 0.5) * (tile.unit, tile.unit * aspect)
    np.testing.assert_allclose(plane, expected, atol=1e-3)


@pytest.mark.parametrize("azimuth", [0, 90, 200])
def test_positions_in_the_footprint_do_not_follow_light_directions(azimuth: float) -> None:
    """Under a wide light each direction has its own irradiance."""
    ramp = np.linspace(0.0, 1.0, 64, dtype=np.float32)
    pixels = np.zeros((64, 64, 3), np.float32)
    pixels[..., 0], pixels[..., 1] = ramp[None, :], ramp[::-1, None]
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}
    estimator = Estimator(build_scene(flat(), bsdf), LightKernel(30.0), Transport())
    q = queries([0.5, 0.5], 0.1, direction(40, azimuth), direction(60, 10), 4000)
    e = estimator.estimate(q, 32, Stream(2, "test", 0))
    for channel in (0, 1):
        mean = mean_of_halves(e.value_a[:, channel], e.value_b[:, channel])
        assert mean.relative_error < 5e-3
        assert t_test(mean, 0.5 / np.pi).p_value > 1e-3
