"""Each path of the estimator has its own random numbers; values depend on nothing else."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import drjit as dr
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ks_2samp
from support.scenes import (
    Estimator,
    HeightGrid,
    LightKernel,
    Stream,
    Transport,
    build_scene,
    direction,
    estimate,
    flat,
    lambert,
    mi,
    queries,
    rocks,
)

from mbtf_core.stats import mean_estimate, t_test
from mbtf_gen.render.estimates import MOST_LOCATED


def estimator(launch: int = 1 << 20, **options: Any) -> Estimator:
    return Estimator(build_scene(rocks(32), lambert(0.8)), LightKernel(5.0), Transport(**options), launch)


def same_query(n: int) -> Any:
    return queries([0.3, 0.7], 0.1, direction(40, 60), direction(55, 200), n)


def test_one_path_in_each_half_has_the_variance_of_two_numbers() -> None:
    e = estimator().estimate(same_query(500), 2, Stream(0, "train", 0), path_variance=True)
    expected = 0.5 * np.mean((e.value_a.astype(np.float64) - e.value_b) ** 2, axis=1)
    assert expected.max() > 1e-3
    np.testing.assert_allclose(e.path_variance, expected, rtol=1e-3, atol=1e-6)


def test_values_differ_between_streams_and_are_uncorrelated() -> None:
    n = 4000
    streams = [Stream(0, "train", 0), Stream(0, "train", 1), Stream(0, "test", 0), Stream(1, "train", 0)]
    e = estimator()
    values = [e.estimate(same_query(n), 8, s) for s in streams]
    means = [0.5 * (v.value_a + v.value_b)[:, 0].astype(np.float64) for v in values]
    for x, y in combinations(means, 2):
        assert abs(np.corrcoef(x, y)[0, 1]) < 4.5 / np.sqrt(n)


def test_launches_of_any_size_share_their_kernels() -> None:
    """Compiling takes seconds and a launch tenths of a second, so kernels must not depend on the launch."""
    surface = {"type": "mbtf_surface", "roughness": 0.3, "specular": 0.5, "metallic": 0.4, "clearcoat": 0.3}
    e = Estimator(build_scene(rocks(32), surface), LightKernel(5.0), Transport())
    e.estimate(same_query(300), 8, Stream(0, "train", 0))
    # Another number of queries, of another relief, with other limits on the paths.
    # (Reliefs whose sides are no powers of two have kernels of their own.)
    other = Estimator(build_scene(rocks(64, 0.1), surface), LightKernel(2.0), Transport(7, 2))
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        dr.kernel_history()
        other.estimate(same_query(411), 8, Stream(3, "test", 5))
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, before)
    # Small ones prepare and collect; the two large ones trace.
    large = [k for k in kernels if k["operation_count"] > 1000]
    assert len(large) == 2
    assert all(k["cache_hit"] for k in large)


class Faulty(mi.BSDF):  # type: ignore[misc]
    """Albedo 1/2, with NaN or infinite values on a twentieth of the tile, in `stripes`."""

    def __init__(self, props: Any, bad: float, stripes: float = 1000.0) -> None:
        mi.BSDF.__init__(self, props)
        self.bad, self.stripes = bad, stripes
        self.inner = mi.load_dict(lambert(0.5))
        self.m_flags = self.inner.flags()
        self.m_components = [self.inner.flags()]

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        x = self.stripes * si.uv.x
        return dr.select(x - dr.floor(x) < 0.05, mi.Color3f(self.bad), self.inner.eval(ctx, si, wo, active))

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.inner.pdf(ctx, si, wo, active)

    def sample(self, ctx: Any, si: Any, s1: Any, s2: Any, active: Any = True) -> Any:
        return self.inner.sample(ctx, si, s1, s2, active)


@pytest.mark.parametrize("lights", [1, 4])
@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_nonfinite_samples_are_resampled_and_counted(bad: float, lights: int) -> None:
    n, spp = 500, 8
    tile = build_scene(flat(), Faulty(mi.Properties(), bad))
    e = Estimator(tile, LightKernel(0.0), Transport(max_depth=1))
    values = e.estimate(same_query(n * lights), spp, Stream(0, "train", 0), lights=lights)
    # One path in twenty, and of those one in twenty again; none is left in the values.
    assert values.nonfinite == pytest.approx(n * spp / 19, rel=0.3)
    np.testing.assert_allclose([values.value_a, values.value_b], 0.5 / np.pi, rtol=1e-5)


def test_nonfinite_samples_are_located() -> None:
    """One facet of a groove has a faulty stripe: the other one fails by light reflected from it."""
    groove = HeightGrid(np.tile([0.0, -0.4], (2, 1)), 1.0)
    e = Estimator(build_scene(groove, Faulty(mi.Properties(), np.nan, 1.0)), LightKernel(0.0), Transport())
    n = 500
    u = np.array([[0.5, 0.5]] * n + [[0.08, 0.5]] * n)
    for effect, first in (("interreflection", 0), ("direct light", n)):
        q = queries(np.roll(u, -first, axis=0), 0.02, direction(80, 90), direction(90, 0), 2 * n)
        values = e.estimate(q, 8, Stream(0, "train", 0))
        assert values.nonfinite > MOST_LOCATED == len(values.bad_samples)
        # Some paths come back to the stripe from the other facet.
        assert sum(bad.effect == effect for bad in values.bad_samples) > MOST_LOCATED // 2
        assert all(0 <= bad.query < n for bad in values.bad_samples)


N = 30_000
GRID = rocks(48, 0.2)
SURFACES = {
    # Rough enough that no value is an outlier that decides the moments.
    "principled": {"type": "principled", "base_color": {"type": "rgb", "value": 0.7}, "roughness": 0.5},
    "lambert": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
}


@pytest.fixture(
    scope="module", params=[("principled", 5.0, 2), ("principled", 1.0, 16), ("lambert", 0.0, 4)], ids=str
)
def halves(request: pytest.FixtureRequest) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Both halves (N,) of one query, estimated N times."""
    surface, width, spp = request.param
    q = queries([0.3, 0.6], 0.2, direction(35, 60), direction(50, 200), N)
    e = estimate(GRID, SURFACES[surface], LightKernel(width), q, spp)
    return e.value_a[:, 1].astype(np.float64), e.value_b[:, 1].astype(np.float64)


Halves = tuple[NDArray[np.float64], NDArray[np.float64]]


def test_noise_of_the_halves_is_uncorrelated(halves: Halves) -> None:
    a, b = (x - x.mean() for x in halves)
    # Also of one query's half with the next query's, and of squares: what a shared path would show.
    for x, y in (
        (a, b),
        (a[1:], a[:-1]),
        (a[1:], b[:-1]),
        (b[1:], a[:-1]),
        (a**2 - np.mean(a**2), b**2 - np.mean(b**2)),
    ):
        assert t_test(mean_estimate(x * y)).p_value > 1e-3


def test_halves_are_equal_in_distribution(halves: Halves) -> None:
    a, b = halves
    assert a.std() > 0.05 * a.mean()
    assert ks_2samp(a, b).pvalue > 1e-3
    assert t_test(mean_estimate(a - b)).p_value > 1e-3


def test_their_difference_measures_the_variance_of_their_mean(halves: Halves) -> None:
    a, b = halves
    mean = 0.5 * (a + b)
    spread = (mean - mean.mean()) ** 2 * N / (N - 1)
    assert t_test(mean_estimate(spread - 0.25 * (a - b) ** 2)).p_value > 1e-3
