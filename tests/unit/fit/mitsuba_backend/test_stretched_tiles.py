"""Tiles that texture coordinates stretch and shear."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.known_surfaces import geometry
from support.plugin_materials import deviation, write_material
from support.scenes import mi

from mbtf_core.data.lattice import Lattice
from mbtf_fit import Material
from mbtf_fit.backends.mitsuba.evaluator import Evaluator
from mbtf_fit.backends.mitsuba.frame import Frame
from mbtf_fit.backends.mitsuba.shade import DirectLight
from mbtf_fit.backends.mitsuba.stored_material import read_material
from mbtf_fit.surface.known import KnownSurface

LAYERS = {"roughness": 0.4, "metallic": 0.5, "clearcoat": (0.7, 0.3)}
SLOPE, SCATTER = np.array([0.9, -0.3]), np.array([[0.3, 0.1], [0.1, 0.2]])
MIRRORED = np.array([[1.0, 0.7], [0.2, -0.86]])


def facets(folder: Path, change: np.ndarray, layers: dict[str, Any]) -> Material:
    """A plane of facets whose slopes are changed by a matrix."""
    lattice = Lattice(2)
    mean, scatter = change @ SLOPE, change @ SCATTER @ change.T
    given = geometry(lattice, np.zeros((4, 4), np.float32), slope=tuple(mean), **layers)
    moments = (np.outer(mean, mean) + scatter)[[0, 0, 1], [0, 1, 1]].astype(np.float32)
    given = replace(given, slope_moments=np.broadcast_to(moments, given.slope_moments.shape))
    known = KnownSurface.of(given, lattice, 1.0)
    return write_material(folder, model="relief", finest=2, constant=(0.1,) * 3, known=known)


@pytest.mark.parametrize("layers", [{}, LAYERS])
@pytest.mark.parametrize("stretch", [np.diag([1.5, 1 / 1.5]), MIRRORED / np.sqrt(-np.linalg.det(MIRRORED))])
def test_facets_reflect_as_they_lie_on_the_surface(
    stretch: np.ndarray, layers: dict[str, Any], tmp_path: Path
) -> None:
    """As PyTorch evaluates a tile that is not stretched and has the slopes and scatter of the surface."""
    n, random = 300, np.random.default_rng(2)
    omega = random.uniform(-0.6, 0.6, (2, n, 3))
    omega[..., 2] = np.sqrt(1 - (omega[..., :2] ** 2).sum(-1))
    tile = np.concatenate([omega[..., :2] @ np.linalg.inv(stretch).T, omega[..., 2:]], -1)
    tile /= np.linalg.norm(tile, axis=-1, keepdims=True)
    u, sigma = random.random((n, 2)), np.full(n, 0.2)
    wanted = facets(tmp_path / "plain", np.linalg.inv(stretch).T, layers).evaluate(u, sigma, *omega)
    flat = facets(tmp_path / "tile", np.eye(2), layers).evaluate(u, sigma, *tile)
    evaluator = Evaluator(read_material(tmp_path / "tile"))
    light, view = (mi.Vector3f(w.astype(np.float32).T) for w in tile)
    frame = Frame(*(mi.Vector2f(*column.tolist()) for column in stretch.T), mi.Float(1.0), mi.Float(1.0))
    level = evaluator.level(mi.Float(sigma.astype(np.float32)))
    values = evaluator.stage1(mi.Point2f(u.astype(np.float32).T), level, view)
    found = np.array(evaluator.value(values, light, frame=frame)).T
    assert deviation(flat, wanted) > 0.05
    assert deviation(found, wanted) < 1e-3


@pytest.mark.parametrize("stretch", [np.eye(2), MIRRORED / np.sqrt(-np.linalg.det(MIRRORED))])
def test_slopes_at_a_height_are_those_of_the_offset_surface(stretch: np.ndarray) -> None:
    """Of a paraboloid whose points lie at heights along its normals, by differences."""
    curved, s, height, step = np.array([[0.9, 0.3], [0.3, -0.4]]), np.array([0.3, -0.2]), -0.3, 1e-4

    def point(u: np.ndarray) -> np.ndarray:
        x = stretch @ u
        n = np.append(curved @ x, 1.0)
        return np.append(x, -0.5 * x @ curved @ x) + (height + s @ u) * n / np.linalg.norm(n)

    along, across = ((point(step * e) - point(-step * e)) / (2 * step) for e in np.eye(2))
    normal = np.cross(along, across)
    expected = -normal[:2] / normal[2]
    frame = Frame(*(mi.Vector2f(*column.tolist()) for column in stretch.T), mi.Float(1.0), mi.Float(1.0))
    form = stretch.T @ curved @ stretch
    sag = mi.Vector3f(*(height * form[[0, 0, 1], [0, 1, 1]]).tolist())
    found, flat = (np.array(frame.slope(mi.Vector2f(*s.tolist()), x)).ravel() for x in (sag, None))
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.abs(flat - expected).max() > 0.03


def test_facets_at_a_depth_are_steeper_over_a_cylinder(tmp_path: Path) -> None:
    """As PyTorch evaluates a plane of such slopes."""
    kappa, height, n, random = 1.5, -0.2, 300, np.random.default_rng(2)
    omega = random.uniform(-0.6, 0.6, (2, n, 3))
    omega[..., 2] = np.sqrt(1 - (omega[..., :2] ** 2).sum(-1))
    u, sigma = random.random((n, 2)), np.full(n, 0.2)
    steeper = np.diag([1.0 / (1.0 + kappa * height), 1.0])
    wanted = facets(tmp_path / "steep", steeper, LAYERS).evaluate(u, sigma, *omega)
    plain = facets(tmp_path / "tile", np.eye(2), LAYERS).evaluate(u, sigma, *omega)
    evaluator = Evaluator(read_material(tmp_path / "tile"))
    light, view = (mi.Vector3f(w.astype(np.float32).T) for w in omega)
    level = evaluator.level(mi.Float(sigma.astype(np.float32)))
    values = evaluator.stage1(mi.Point2f(u.astype(np.float32).T), level, view)
    form, heights = mi.Vector3f(kappa, 0.0, 0.0), [mi.Float(height)] * 4
    lit = DirectLight(light, mi.Float(0.1), mi.Bool(False), form, mi.Float(0.25), heights)
    frame = Frame(mi.Vector2f(1, 0), mi.Vector2f(0, 1), mi.Float(1.0), mi.Float(1.0))
    found = np.array(evaluator.value(values, light, lit, frame)).T
    assert deviation(plain, wanted) > 0.03
    assert deviation(found, wanted) < 1e-3
