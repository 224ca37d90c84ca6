"""Queries and the functions they are drawn by: the same bits everywhere, and every texel once a pass."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from conftest import RunPython
from numpy.typing import NDArray
from scipy.stats import kstest
from support.datasets import write_dataset

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_gen.sampling.exact_math import exp, exp2, log, sincos_turns
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan, direction_pairs, slice_directions

# Draws of every kind, and the elementary functions in double precision, where the last bit shows; numbers of
# paths by a run's allocation and for a target error; draws by highlights. Prints NumPy's features in use and
# digests of all bits.
CODE = """
import hashlib, json
import numpy as np
from mbtf_gen.sampling.exact_math import exp2, sincos_turns
from mbtf_core.data.lattice import Lattice
from mbtf_gen.planning.adaptive import needed_paths, round_up
from mbtf_gen.planning.highlights import Highlights
from mbtf_gen.planning.sample_allocation import Allocation
from mbtf_gen.render.estimates import Estimates
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan
h = hashlib.sha256()
for layout, lattice, rows in (("shuffled", Lattice(5, 0.75), 5000), ("image", Lattice(4, 1.0), 7)):
    plan = QueryPlan(lattice, LevelMixture(0.6, 0.4), 0.1, layout, 11, rows)
    for split, shard in (("train", 0), ("train", 3), ("test", 1)):
        q = plan.draw(split, shard, rows)
        for array in (q.u, q.sigma, q.omega_i, q.omega_o):
            assert array.dtype == np.float32
            h.update(np.ascontiguousarray(array).tobytes())
x = np.random.Generator(np.random.Philox(1)).random(20000)
for array in (exp2(-14 * x), *sincos_turns(x)):
    h.update(array.tobytes())
n, c = 20000, hashlib.sha256()
weights = [tuple((k % 7) / 20 - 0.15 for k in range(count)) for count in (55, 45)]
allocation = Allocation(weights[0], 0.1, 1.0, 1.0, weights[1])
q = QueryPlan(Lattice(6), LevelMixture(0.6, 0.4), 0.1, "shuffled", 0, n).draw("train", 3, n)
rng = np.random.Generator(np.random.Philox(5))
a, b, v = (0.3 * rng.random((n, k), dtype=np.float32) for k in (3, 3, 1))
pilot = Estimates(a, b, None, 0, 0, 0, 0, path_variance=v[:, 0])
expected = allocation.deviation(q), allocation.tile_mean(q)
needed, scale = needed_paths(pilot, 16, *expected, 0.05)
for array in (*expected, needed, scale, allocation.counts(q, 16), round_up(needed, 1000)):
    c.update(array.tobytes())
plan = QueryPlan(Lattice(6), LevelMixture(0.6, 0.4), 0.1, "shuffled", 0, n)
q, weight = Highlights(weights[0], 0.75).draw(plan, 2, 2000)
for array in (q.u, q.sigma, q.omega_i, q.omega_o, weight):
    c.update(array.tobytes())
found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
print(json.dumps({"found": found, "digests": [h.hexdigest(), c.hexdigest()]}))
"""
DIGEST = "29bf97bc8100b9038a075a49ff564f26538593acf0f925c65b3ebb6c16f59908"


def sampled_in_child(run_python: RunPython, **variables: str | None) -> tuple[list[str], list[str]]:
    done = run_python("-c", CODE, **variables)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    return answer["found"], answer["digests"]


def test_bits_do_not_depend_on_the_processors_features(run_python: RunPython) -> None:
    found, digests = sampled_in_child(run_python, NPY_DISABLE_CPU_FEATURES=None)
    # The same bits as on every machine so far: data sets are made by several of them.
    assert digests[0] == DIGEST
    if not found:
        pytest.skip("NumPy uses no optional features of this processor")
    for disabled in (found, found[-1:]):
        left, again = sampled_in_child(run_python, NPY_DISABLE_CPU_FEATURES=" ".join(disabled))
        assert len(left) < len(found)
        assert again == digests


LATTICES = [Lattice(*k) for k in ((3, 1.0), (3, 0.75), (4, 5 / 16), (2, 2.5), (0, 1.0), (0, 3.0))]


def texels(lattice: Lattice, u: NDArray[np.float32]) -> NDArray[np.int64]:
    """Texel number of positions (n, 2), row 0 the side v → 1."""
    rows, columns = lattice.shape()
    i = np.floor(u[:, 0].astype(np.float64) * columns).astype(int) % columns
    j = np.floor((1.0 - u[:, 1].astype(np.float64)) * rows).astype(int) % rows
    return j * columns + i


def plan(lattice: Lattice, shard_rows: int, layout: str = "shuffled", root: int = 5) -> QueryPlan:
    return QueryPlan(lattice, LevelMixture(0.6, 0.4), 0.2, layout, root, shard_rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda k: "x".join(map(str, k.shape())))
@pytest.mark.parametrize("shard_rows", [7, 64])
def test_each_pass_covers_each_texel_once_across_shards(lattice: Lattice, shard_rows: int) -> None:
    count = lattice.texels()
    passes = 4
    total = passes * count + count // 2
    shards = [
        plan(lattice, shard_rows).draw("train", s, min(shard_rows, total - s * shard_rows))
        for s in range(-(-total // shard_rows))
    ]
    visited = texels(lattice, np.concatenate([q.u for q in shards]))
    assert len(visited) == total
    for sweep in range(passes):
        assert sorted(visited[sweep * count : (sweep + 1) * count]) == list(range(count))
    # The unfinished pass repeats nothing, and passes have orders of their own.
    assert len(set(visited[passes * count :])) == total - passes * count
    if count > 8:
        assert len({tuple(visited[s * count : (s + 1) * count]) for s in range(passes)}) == passes


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda k: "x".join(map(str, k.shape())))
def test_images_hold_every_texel_in_order_under_one_light_and_view(lattice: Lattice) -> None:
    q = plan(lattice, 3, "image").draw("train", 2, 3)
    assert q.lead == (3, *lattice.shape())
    for item in range(3):
        assert texels(lattice, q.u[item].reshape(-1, 2)).tolist() == list(range(lattice.texels()))
        for array in (q.sigma, q.omega_i, q.omega_o):
            first = array[item, 0, 0]
            assert (array[item] == first).all()
    # Images differ from one another, jitter included.
    assert len(np.unique(q.omega_i[:, 0, 0], axis=0)) == 3
    assert len(np.unique(q.u[:, 0, 0], axis=0)) == 3


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda k: "x".join(map(str, k.shape())))
def test_patches_are_grids_of_the_level_nearest_to_their_footprint(lattice: Lattice) -> None:
    q = QueryPlan(lattice, LevelMixture(1, 0), 0.2, "image", 5, 40, patch_size=5).draw("train", 1, 40)
    assert q.lead == (40, 5, 5)
    assert ((q.u >= 0) & (q.u < 1)).all()
    for item in range(40):
        for array in (q.sigma, q.omega_i, q.omega_o):
            assert (array[item] == array[item, 0, 0]).all()
        level = min(max(round(-np.log2(2 * float(q.sigma[item, 0, 0]))), 0), lattice.finest)
        rows, columns = lattice.shape(level)
        # Rows go down the tile, against v, and columns to the right; around the tile.
        for axis, step in ((1, (1 / columns, 0)), (0, (0, -1 / rows))):
            apart = np.diff(q.u[item].astype(np.float64), axis=axis) - step
            np.testing.assert_allclose(apart, np.round(apart), atol=1e-6)
    # They begin anywhere.
    assert len(np.unique(q.u[:, 0, 0])) == 80
    assert np.ptp(q.u[:, 0, 0], axis=0).min() > 0.7


def equal(a: Queries, b: Queries) -> bool:
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in ("u", "sigma", "omega_i", "omega_o"))


def test_a_shard_does_not_depend_on_the_others() -> None:
    company = plan(LATTICES[1], 50)
    many = [company.draw("train", s, 50) for s in range(6)]
    for s in (5, 0, 3):
        assert equal(plan(LATTICES[1], 50).draw("train", s, 50), many[s])
    assert not equal(many[0], many[1])


def test_lights_of_a_group_share_one_query_of_a_plan_without_groups() -> None:
    company = replace(plan(LATTICES[1], 3000), lights=3)
    for shard in (0, 2):
        alone = plan(LATTICES[1], 1000).draw("train", shard, 1000)
        found = company.draw("train", shard, 3000)
        for name in ("u", "sigma", "omega_o"):
            assert (getattr(found, name).reshape(3, 1000, -1) == getattr(alone, name).reshape(1000, -1)).all()
        # As independent as those of other queries, and as uniform: r² on the projected disk, and the azimuth.
        lights = found.omega_i.astype(np.float64).reshape(3, 1000, 3)
        radius2 = (lights[..., 0] ** 2 + lights[..., 1] ** 2) / (1 - 0.2**2)
        turns = np.arctan2(lights[..., 1], lights[..., 0]) / (2 * np.pi) + 0.5
        for numbers in (radius2, turns):
            assert kstest(numbers.ravel(), "uniform").pvalue > 1e-3
            others = (alone.omega_i[:, 2], alone.omega_o[:, 2], *numbers[1:])
            for other in others:
                assert abs(np.corrcoef(numbers[0], other)[0, 1]) < 5 / np.sqrt(1000)
    # Test queries have paths of their own.
    assert equal(company.draw("test", 1, 3000), plan(LATTICES[1], 3000).draw("test", 1, 3000))


def test_splits_shards_and_roots_have_different_queries() -> None:
    samples = [
        plan(LATTICES[1], 1000, root=root).draw(split, shard, 1000)
        for root, split, shard in ((3, "train", 0), (3, "train", 1), (3, "test", 0), (4, "train", 0))
    ]
    for a, b in combinations(samples, 2):
        for name in ("u", "sigma", "omega_i", "omega_o"):
            one, other = (getattr(q, name).reshape(1000, -1)[:, 0] for q in (a, b))
            assert np.mean(one == other) < 0.01
            assert abs(np.corrcoef(one, other)[0, 1]) < 5 / np.sqrt(1000)


@pytest.mark.parametrize("layout", ["shuffled", "image"])
def test_every_number_is_within_its_range(layout: str) -> None:
    lattice = Lattice(6, 0.75)
    low, high = lattice.sigma_range
    for shard in range(3):
        rows = 20_000 if layout == "shuffled" else 6
        q = plan(lattice, rows, layout).draw("test", shard, rows).flat()
        assert (q.u >= 0).all()
        assert (q.u < 1).all()
        assert (q.sigma >= np.float32(low)).all()
        assert (q.sigma <= np.float32(high)).all()
        for omega in (q.omega_i, q.omega_o):
            length = np.linalg.norm(omega.astype(np.float64), axis=-1)
            np.testing.assert_allclose(length, 1.0, rtol=0, atol=1e-6)
            assert (omega[:, 2] >= np.float32(0.2)).all()


@pytest.mark.parametrize(("count", "min_cos"), [(1, 0.5), (20, 0.1), (151, 0.3)])
def test_the_spiral_covers_the_projected_disk_evenly(count: int, min_cos: float) -> None:
    omega = slice_directions("spiral", count, min_cos).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(omega, axis=1), 1.0, atol=1e-6)
    assert omega[:, 2].min() >= min_cos
    # One direction in each ring of equal area, and no half of the disk has many more than the other.
    area = (omega[:, 0] ** 2 + omega[:, 1] ** 2) / (1.0 - min_cos**2) * count
    np.testing.assert_allclose(area, np.arange(count) + 0.5, atol=1e-3)
    if count > 10:
        assert np.abs(omega[:, :2].mean(axis=0)).max() < 0.05


def test_the_measured_directions_are_those_of_bonn() -> None:
    """81 directions: every 15° from the normal, with 1, 6, 12, 18, 20 and 24 azimuths."""
    omega = slice_directions("ubo2003", 7, 0.1).astype(np.float64)
    angle = np.round(np.degrees(np.arccos(np.minimum(omega[:, 2], 1.0))), 2)
    assert [list(a) for a in np.unique(angle, return_counts=True)] == [
        [*range(0, 90, 15)],
        [1, 6, 12, 18, 20, 24],
    ]
    azimuth = np.degrees(np.arctan2(omega[:, 1], omega[:, 0])) % 360.0
    np.testing.assert_allclose(azimuth[angle == 60.0], 18.0 * np.arange(20), atol=1e-4)


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_every_texel_has_one_slice_at_its_center(aspect: float) -> None:
    lattice = Lattice(3, aspect)
    directions = slice_directions("spiral", 4, 0.2)
    plan = QueryPlan(lattice, LevelMixture(1, 0), 0.2, "slices", 3, 10, None, directions)
    count = lattice.texels()
    shards = [plan.draw("train", s, min(10, count - 10 * s)) for s in range(-(-count // 10))]
    u = np.concatenate([q.u for q in shards])
    assert u.shape == (count, 16, 2)
    assert (u == u[:, :1]).all()
    rows, columns = lattice.shape()
    place = u[:, 0] * (columns, rows) - 0.5
    np.testing.assert_allclose(place, np.round(place), atol=1e-4)
    assert len(np.unique(np.round(place), axis=0)) == count
    light, view = direction_pairs(directions)
    for q in shards:
        assert (q.omega_i == light).all()
        assert (q.omega_o == view).all()
        np.testing.assert_allclose(q.sigma, 0.5 / 8)


def test_test_queries_are_those_of_the_shuffled_layout() -> None:
    directions = slice_directions("spiral", 4, 0.2)
    plan = QueryPlan(Lattice(3), LevelMixture(0.6, 0.4), 0.2, "slices", 3, 10, None, directions)
    shuffled = QueryPlan(Lattice(3), LevelMixture(0.6, 0.4), 0.2, "shuffled", 3, 10)
    for found, expected in zip(
        vars(plan.draw("test", 2, 10)).values(), vars(shuffled.draw("test", 2, 10)).values(), strict=True
    ):
        assert (found[:, 0] == expected).all()


def test_a_data_set_rounds_down_to_squares(tmp_path) -> None:  # type: ignore[no-untyped-def]
    queries = {"train": "11/texel", "test": "50", "layout": "slices", "resolution": 4}
    data = write_dataset(tmp_path / "shards", queries=queries)
    arrays = data.load("train")
    assert data.manifest["slice_size"] == 9
    assert data.manifest["splits"]["train"]["queries"] == 9 * data.lattice.texels()
    assert arrays["value_a"].shape == (data.lattice.texels(), 9, 3)
    assert data.load("test")["sigma"].shape == (50, 1)


TOLERANCE = 1e-14


def turns() -> NDArray[np.float64]:
    """Random turns, and those around the joints of the quarter turns."""
    joints = np.arange(-16, 17) / 8
    near = [joints + d for d in (0.0, 1e-16, -1e-16, 1e-9, -1e-9)]
    return np.concatenate([np.random.default_rng(0).uniform(-2.0, 2.0, 20_000), *near])


def test_sine_and_cosine_are_those_of_numpy() -> None:
    t = turns()
    sine, cosine = sincos_turns(t)
    # NumPy takes 2πt, which is itself rounded: up to 1e-15 of angle.
    np.testing.assert_allclose(sine, np.sin(2 * np.pi * t), rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(cosine, np.cos(2 * np.pi * t), rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(sine**2 + cosine**2, 1.0, rtol=0, atol=TOLERANCE)


def test_quarter_turns_are_exact() -> None:
    sine, cosine = sincos_turns(np.arange(-8, 9) / 4)
    quarter = np.arange(-8, 9) % 4
    np.testing.assert_array_equal(sine, np.array([0.0, 1.0, 0.0, -1.0])[quarter])
    np.testing.assert_array_equal(cosine, np.array([1.0, 0.0, -1.0, 0.0])[quarter])


def test_powers_of_two_are_those_of_numpy() -> None:
    x = np.concatenate([np.random.default_rng(1).uniform(-60, 60, 20_000), np.arange(-20, 20) + 0.5])
    np.testing.assert_allclose(exp2(x), np.exp2(x), rtol=TOLERANCE)
    whole = np.arange(-1000, 1000)
    np.testing.assert_array_equal(exp2(whole.astype(np.float64)), np.ldexp(1.0, whole))


def test_exponentials_and_logarithms_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    x = np.concatenate([rng.uniform(-60, 60, 20_000), [0.0]])
    np.testing.assert_allclose(exp(x), np.exp(x), rtol=TOLERANCE)
    y = np.concatenate([np.exp(x), np.nextafter(1.0, [0.0, 2.0]), [1e-300, 1e300]])
    np.testing.assert_allclose(log(y), np.log(y), rtol=TOLERANCE)
    assert log(np.array([1.0]))[0] == 0.0
    whole = np.arange(-900, 900)
    assert (np.rint(log(np.ldexp(1.0, whole)) / np.log(2.0)) == whole).all()
