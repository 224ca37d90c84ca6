"""Intersections and horizons: the kernel, PyTorch, the renderer's tracer, and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from support.fit_data import random_directions
from support.known_surfaces import rough_heights
from support.scenes import mi

from mbtf_fit.native import library
from mbtf_fit.surface import heightfield
from mbtf_fit.surface.heightfield import HeightfieldTracer, horizons_reference, trace_reference
from mbtf_gen.tile.tracers.heightfield_tracer import HeightfieldGeometry

needs_kernel = pytest.mark.skipif(library.kernel() is None, reason=library.missing_reason() or "kernel")
SHAPES = [(16, 16), (5, 12), (1, 9), (7, 1), (33, 20)]


def rays(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points all over the plane and views down to a cosine of 1e-3."""
    random = np.random.default_rng(seed)
    omega = random_directions(random, n)
    low = slice(0, n // 8)
    omega[low, 2] = 1e-3
    omega[low, :2] /= np.linalg.norm(omega[low, :2], axis=1, keepdims=True)
    u = 5 * random.random((n, 2)) - 2
    return torch.from_numpy(u.astype(np.float32)), torch.from_numpy(omega)


@pytest.mark.parametrize("shape", SHAPES)
def test_kernel_pytorch_and_renderer_agree(shape: tuple[int, int]) -> None:
    heights, aspect = rough_heights(*shape), shape[0] / shape[1]
    tracer = HeightfieldTracer(heights, aspect)
    u, omega = rays(4000)
    cells = torch.from_numpy(tracer._nodes[: heights.size]).view(*shape, 4)
    found = tracer.trace(u, omega)
    torch.testing.assert_close(found, trace_reference(cells, aspect, u, omega), atol=2e-6, rtol=0)
    field = HeightfieldGeometry.of(heights.astype(np.float64), aspect, 1.0, False)
    x, y = ((u - u.floor()).numpy().T - 0.5) * np.array([[1.0], [aspect]], np.float32)
    ray = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), 0.0), -mi.Vector3f(omega.numpy().T.copy()))
    rendered = np.array(field.closest_hit(ray, mi.Bool(True), 64)[0].p.z)
    difference = np.abs(rendered - found.numpy())
    # A ray that just misses an edge in one of them hits in the other.
    assert np.quantile(difference, 0.995) < 2e-5
    assert -heights.min() >= -found.min() > 0


def test_a_ridge_is_hit_where_its_flank_says() -> None:
    """Columns 0, -h, -h, -h: the flank from x = 1/8 to 3/8 falls by h."""
    h, view = 0.3, np.array([0.6, 0.0, 0.8])
    tracer = HeightfieldTracer(np.tile(np.float32([0, -h, -h, -h]), (4, 1)), 1.0)
    u = torch.tensor([[0.25, 0.3], [1.25, -0.7]])
    omega = torch.from_numpy(np.tile(view, (2, 1)).astype(np.float32))
    wanted = -(h / 2) / (1 + 4 * h * view[0] / view[2])
    np.testing.assert_allclose(tracer.trace(u, omega), wanted, rtol=1e-5)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 8), (5, 12)])
def test_a_flat_grid_is_met_at_once_and_hides_no_light(shape: tuple[int, int]) -> None:
    tracer = HeightfieldTracer(np.zeros(shape, np.float32), shape[0] / shape[1])
    assert float(tracer.trace(*rays(500)).abs().max()) < 1e-6
    assert float(tracer.horizons(16).abs().max()) == 0


@pytest.mark.parametrize("compiled", [pytest.param(True, marks=needs_kernel), False])
@pytest.mark.parametrize("towards", [(1, 0), (-1, 0), (0, 1)])
def test_lines_along_a_trench_meet_its_floor_many_tiles_away(
    compiled: bool, towards: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Walls touch the plane, the floor lies at -0.3. Grazing lines end behind their 65th border."""
    if not compiled:
        monkeypatch.setattr(heightfield, "kernel", lambda: None)
    trench = np.tile(np.float32([0, -0.3, -0.3, -0.3, -0.3, -0.3]), (3, 1))
    aspect = 0.5 if towards[1] else 2.0
    tracer = HeightfieldTracer(trench if towards[1] else trench.T.copy(), aspect)
    columns, rows = tracer._z.shape[::-1]
    along = 1 if towards[1] else 0
    period, texels = ((1.0, columns), (aspect, rows))[along]
    n = 200
    u = np.random.default_rng(0).uniform(-2, 2, (n, 2))
    # Columns 1 to 5 of the trench, rows from its top.
    u[:, 1 - along] = 0.6
    for cosine in (0.3, 0.05):
        sine = np.sqrt(1 - cosine**2)
        omega = np.tile([sine * towards[0], sine * towards[1], cosine], (n, 1))
        found = tracer.trace(*(torch.from_numpy(a.astype(np.float32)) for a in (u, omega)))
        np.testing.assert_allclose(found, -0.3, rtol=1e-5)
    cosine = 1e-3
    omega = np.tile([*towards, cosine], (n, 1)) / np.sqrt(1 + cosine**2)
    found = tracer.trace(*(torch.from_numpy(a.astype(np.float32)) for a in (u, omega))).numpy()
    # The line runs against omega; periods begin at the center of the first texel.
    first = (u[:, along] - 0.5 / texels) * sum(towards) % 1
    np.testing.assert_allclose(found, -cosine * period * (64 + first), rtol=1e-4)


def test_numbers_that_are_not_finite_end() -> None:
    tracer = HeightfieldTracer(rough_heights(8, 8), 1.0)
    u = torch.tensor([[np.nan, 0.5], [0.5, np.inf], [0.1, 0.1]])
    omega = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [np.nan, 0.0, 1.0]])
    assert len(tracer.trace(u, omega)) == 3


@needs_kernel
@pytest.mark.parametrize("shape", SHAPES)
def test_horizons_of_kernel_and_numpy_agree(shape: tuple[int, int]) -> None:
    heights, aspect = rough_heights(*shape), shape[0] / shape[1]
    found = HeightfieldTracer(heights, aspect).horizons(16)
    np.testing.assert_allclose(found, horizons_reference(heights[::-1], aspect, 16)[::-1], atol=2e-5)


@pytest.mark.parametrize("axis", [0, 1])
def test_horizons_of_a_ridge(axis: int) -> None:
    """A ridge in column 0, then in row 0: at the next vertex it is 1/4 away on one side, 3/4 on the other."""
    h = 0.3
    heights = np.tile(np.float32([0, -h, -h, -h]), (4, 1))
    heights = heights if axis == 1 else heights.T.copy()
    found = HeightfieldTracer(heights, 1.0).horizons(16).numpy()
    at = found[:, 1] if axis == 1 else found[1]
    # Column 0 lies towards -u, row 0 towards +v.
    near, far = (8, 0) if axis == 1 else (4, 12)
    np.testing.assert_allclose(at[:, near], np.arctan(h / 0.25), rtol=1e-5)
    np.testing.assert_allclose(at[:, far], np.arctan(h / 0.75), rtol=1e-5)
    ridge = found[:, 0] if axis == 1 else found[0]
    assert np.all(ridge == 0)
