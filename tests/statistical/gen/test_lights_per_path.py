"""Paths that several lights share: each query's value has the distribution that paths of its own give it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.paths import ROOT
from support.scenes import Estimator, LightKernel, Stream, Transport, build_scene, direction, rocks
from support.significance import aggregate_test

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_core.stats import mean_estimate, t_test
from mbtf_gen.render.estimates import Estimates
from mbtf_gen.render.scene import TileScene
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan
from mbtf_gen.tile.fiber_tile import FiberScattering, FiberTile
from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.loading import load_material

GROUPS, LIGHTS = 1024, 4


def crossed_fibers() -> FiberTile:
    """Two layers of wavy fibers."""
    s = np.arange(8) / 8
    curves = []
    for k in range(24):
        x, y = s, k / 12 + 0.02 * np.sin(2 * np.pi * (s + 0.3 * k))
        points = np.column_stack([x, y, 0 * s] if k < 12 else [y - 1, x, 0 * s - 0.1])
        curves.append(Curve.through(points, 0.03, np.eye(3)[0 if k < 12 else 1]))
    yarn = np.arange(24) // 12
    colors, scattering = np.array([[0.8, 0.6, 0.3], [0.3, 0.7, 0.8]]), FiberScattering(0.35, 0.4, 3.0)
    return FiberTile.settled(1.0, curves, yarn, colors, (scattering, scattering))


def scene(kind: str) -> TileScene:
    if kind == "heights":
        maps = {"type": "principled", "base_color": {"type": "rgb", "value": 0.7}, "roughness": 0.4}
        return build_scene(rocks(48, 0.2), maps)
    # The scales have an opacity mask.
    tile = crossed_fibers() if kind == "fibers" else load_material(ROOT / "assets" / "fish_scales")
    return build_scene(tile, tile.surface())


@pytest.fixture(scope="module", params=["heights", "mesh", "fibers"])
def tile(request: pytest.FixtureRequest) -> TileScene:
    return scene(request.param)


@pytest.fixture(scope="module")
def groups() -> Queries:
    """Groups of random queries."""
    plan = QueryPlan(Lattice(5), LevelMixture(1.0, 0.0), 0.1, "shuffled", 1, 1 << 16, lights=LIGHTS)
    return plan.draw("train", 0, GROUPS * LIGHTS)


def units(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Values (groups, lights, 3): the queries of a group are correlated."""
    return values.reshape(LIGHTS, -1, 3).swapaxes(0, 1).astype(np.float64)


def test_values_have_the_same_mean_and_the_same_variance(tile: TileScene, groups: Queries) -> None:
    estimator = Estimator(tile, LightKernel(3.0), Transport())
    alone = estimator.estimate(groups, 32, Stream(1, "train", 0))
    shared = estimator.estimate(groups, 32, Stream(2, "train", 0), lights=LIGHTS)
    assert (shared.paths, shared.lost, shared.nonfinite) == (alone.paths / LIGHTS, 0, 0)
    halves = [units(x) for e in (alone, shared) for x in (e.value_a, e.value_b)]
    assert aggregate_test(*halves).p_value > 1e-3
    a1, b1, a2, b2 = halves
    assert t_test(mean_estimate((a1 - b1) ** 2 - (a2 - b2) ** 2)).p_value > 1e-3
    if alone.transmittance is not None:
        # Every light of a group sees what passes the same rays.
        assert (shared.transmittance.reshape(LIGHTS, -1) == shared.transmittance[:GROUPS]).all()
        assert t_test(mean_estimate(alone.transmittance - shared.transmittance)).p_value > 1e-3


def lights_of(kind: str, q: Queries, lights: int, launch: int = 1 << 20) -> Estimates:
    estimator = Estimator(scene(kind), LightKernel(0.0), Transport(), launch)
    return estimator.estimate(q, 8, Stream(1, "train", 0), lights=lights)


@pytest.mark.parametrize("kind", ["heights", "fibers"])
def test_a_delta_light_takes_what_the_same_paths_alone_give_it(kind: str, groups: Queries) -> None:
    """A delta light draws no random numbers, so paths of one light are those of the group."""
    shared = lights_of(kind, groups, LIGHTS)
    for k in range(LIGHTS):
        rows = slice(k * GROUPS, (k + 1) * GROUPS)
        alone = lights_of(kind, groups.take(rows), 1)
        for found, expected in ((shared.value_a[rows], alone.value_a), (shared.value_b[rows], alone.value_b)):
            # Rounding decides differently at a few edges.
            equal = np.isclose(found, expected, rtol=1e-4, atol=1e-6).all(axis=1)
            assert equal.mean() > 0.99


def test_no_light_changes_what_another_one_gets(groups: Queries) -> None:
    estimator = Estimator(scene("heights"), LightKernel(3.0), Transport())
    omega_i = groups.omega_i.copy()
    # All but the second light stand elsewhere, low and bright for some paths.
    changed = np.arange(LIGHTS * GROUPS) // GROUPS != 1
    omega_i[changed] = direction(12, 77)
    one, other = (
        estimator.estimate(q, 8, Stream(1, "train", 0), lights=LIGHTS)
        for q in (groups, replace(groups, omega_i=omega_i))
    )
    assert (one.value_a[~changed] == other.value_a[~changed]).all()
    assert (one.value_b[~changed] == other.value_b[~changed]).all()
    assert (one.value_a[changed] != other.value_a[changed]).mean() > 0.5


def test_halves_of_a_group_are_independent(groups: Queries) -> None:
    """Their paths differ: neither a query's halves nor those of two queries of a group are correlated."""
    one = groups.take(np.arange(LIGHTS) * GROUPS)
    many = Queries(*(np.repeat(array, 4096, axis=0) for array in vars(one).values()))
    estimator = Estimator(scene("heights"), LightKernel(3.0), Transport())
    # The light in the middle of the first group's footprint for each of them.
    wide = replace(
        many, u=0 * many.u, sigma=0 * many.sigma + np.float32(0.3), omega_o=0 * many.omega_o + many.omega_o[0]
    )
    e = estimator.estimate(wide, 2, Stream(5, "train", 0), lights=LIGHTS)
    a, b = (x.mean(axis=1).reshape(LIGHTS, -1).astype(np.float64) for x in (e.value_a, e.value_b))
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (a, b))
    for j in range(LIGHTS):
        for k in range(LIGHTS):
            assert t_test(mean_estimate(a[j] * b[k])).p_value > 1e-4
    # Whereas the queries of a group share what their footprint hits.
    assert t_test(mean_estimate(a[0] * a[1])).p_value < 1e-4


def test_values_do_not_depend_on_launches_and_numbers_of_paths_differ_by_group(groups: Queries) -> None:
    counts = np.tile(np.where(np.arange(GROUPS) % 3, 2, 8), LIGHTS)
    found = [
        Estimator(scene("heights"), LightKernel(3.0), Transport(), launch).estimate(
            groups, counts, Stream(1, "train", 0), lights=LIGHTS, path_variance=True
        )
        for launch in (1 << 20, 1000)
    ]
    for name in ("value_a", "value_b", "path_variance"):
        one, other = (getattr(e, name) for e in found)
        assert np.array_equal(one, other)
    assert found[0].paths == counts.sum() / LIGHTS
    assert np.array_equal(found[0].spp, counts)
