"""Test queries drawn by highlights: weighted means are those over the distribution of all queries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_core.stats import Estimate, mean_estimate, t_test, unexplained_variance
from mbtf_gen import GeneratorConfig, generate
from mbtf_gen.planning.highlights import Highlights, fit_highlights, inclusion
from mbtf_gen.sampling.query_sampler import LevelMixture, QueryPlan

F64 = NDArray[np.float64]
MIN_COS, SHARE, ROWS, SHARDS = 0.1, 0.75, 4096, 6
PLAN = QueryPlan(Lattice(5), LevelMixture(0.6, 0.4), MIN_COS, "shuffled", 7, ROWS)


def ggx(omega_i: F64, omega_o: F64, alpha: float) -> F64:
    """BRDF of a white microfacet plane in 1/sr (Walter et al. 2007), separable Smith shadowing."""
    half = omega_i + omega_o
    z2 = half[..., 2] ** 2 / (half**2).sum(-1)
    d = alpha**2 / (np.pi * (z2 * (alpha**2 - 1) + 1) ** 2)
    out = d / (4 * omega_i[..., 2] * omega_o[..., 2])
    for omega in (omega_i, omega_o):
        tan2 = 1 / omega[..., 2] ** 2 - 1
        out = out * 2 / (1 + np.sqrt(1 + alpha**2 * tan2))
    return out


def value_of(q: Queries, alpha: float = 0.15) -> F64:
    return ggx(q.omega_i.astype(np.float64), q.omega_o.astype(np.float64), alpha)


@pytest.fixture(scope="module")
def truth() -> dict[str, float]:
    """Means of M, M² and (p - M)² of a plane by quadrature; p is a rougher plane."""
    nodes, weights = np.polynomial.legendre.leggauss(90)
    radius2 = 0.5 * (nodes + 1) * (1 - MIN_COS**2)
    # The highlight lies at the angle π between both azimuths: nodes are dense there.
    turn = np.pi * (1 - (0.5 * (nodes + 1)) ** 3)
    measure = 3 * (0.5 * (nodes + 1)) ** 2 * weights / 2
    r, s, phi = np.meshgrid(radius2, radius2, turn, indexing="ij")
    omega_i = np.stack([np.sqrt(r), 0 * r, np.sqrt(1 - r)], -1)
    omega_o = np.stack([np.sqrt(s) * np.cos(phi), np.sqrt(s) * np.sin(phi), np.sqrt(1 - s)], -1)
    w = (weights / 2)[:, None, None] * (weights / 2)[:, None] * measure
    m, p = ggx(omega_i, omega_o, 0.15), ggx(omega_i, omega_o, 0.25)
    return {"mean": float((w * m).sum()), "mse": float((w * (p - m) ** 2).sum()), "one": float(w.sum())}


@pytest.fixture(scope="module")
def plane() -> Highlights:
    """Highlights of the plane, from a pilot of its values."""
    pilot = PLAN.draw("pilot", 0, 8192)
    return fit_highlights(pilot, value_of(pilot), SHARE)


def drawn(highlights: Highlights) -> tuple[Queries, F64]:
    parts = [highlights.draw(PLAN, shard, ROWS) for shard in range(SHARDS)]
    arrays = ([getattr(q, name) for q, _ in parts] for name in ("u", "sigma", "omega_i", "omega_o"))
    queries = Queries(*map(np.concatenate, arrays))
    return queries, np.concatenate([w for _, w in parts]).astype(np.float64)


@pytest.mark.parametrize("kind", ["its own", "constant", "of another material"])
def test_weighted_means_are_those_by_quadrature(
    plane: Highlights, truth: dict[str, float], kind: str
) -> None:
    """Also where the pilot has found other highlights than there are."""
    assert truth["one"] == pytest.approx(1)
    # Retroreflection of light from the side.
    other = np.zeros(len(plane.weights))
    other[4], other[6], other[2] = 1.0, 2.0, -0.5
    weights = {"its own": plane.weights, "constant": (0.0,) * len(other), "of another material": tuple(other)}
    q, w = drawn(Highlights(weights[kind], SHARE))
    m, p = value_of(q), value_of(q, 0.25)
    for found, expected in ((m, truth["mean"]), ((p - m) ** 2, truth["mse"])):
        assert t_test(mean_estimate(found, w), expected).p_value > 1e-3
    # Nothing else changes: levels, positions, each direction.
    level = -np.log2(2 * q.sigma)
    for x, expected in (
        (level, 0.6 * 2.5 + 0.4 * 4.5),
        (q.u[:, 0], 0.5),
        (q.omega_i[:, 2] ** 2, 0.5 * (1 + MIN_COS**2)),
        (q.omega_o[:, 2] ** 2, 0.5 * (1 + MIN_COS**2)),
        (q.omega_o[:, 0], 0.0),
        (q.omega_i[:, 0] * q.omega_o[:, 0] + q.omega_i[:, 1] * q.omega_o[:, 1], 0.0),
    ):
        assert t_test(mean_estimate(x, w), expected).p_value > 1e-3
    assert mean_estimate(w).value == pytest.approx(1, abs=5 * mean_estimate(w).error)
    assert w.min() > 0
    assert w.max() <= (1 + 1e-6) / (1 - SHARE)


def test_few_queries_reach_the_error(plane: Highlights) -> None:
    """The variance of an error is less than a tenth of that of uniform queries, as the pilot says."""
    q, w = drawn(plane)
    uniform = PLAN.draw("train", 0, len(w))
    weighted = mean_estimate((value_of(q) - value_of(q, 0.25)) ** 2, w)
    plain = mean_estimate((value_of(uniform) - value_of(uniform, 0.25)) ** 2)
    assert weighted.error < plain.error / np.sqrt(10)
    assert plane.gain(uniform) > 10
    assert Highlights((0.3, *[0.0] * (len(plane.weights) - 1))).gain(uniform) == pytest.approx(1)
    # No query is counted twice, which would make error bars too small.
    assert len(np.unique(q.omega_i, axis=0)) == len(w)


def test_probabilities_of_selection() -> None:
    size = np.random.default_rng(0).exponential(size=1000) ** 4
    chance = inclusion(size, 200)
    assert chance.sum() == pytest.approx(200)
    assert chance.max() == 1
    inside = chance < 1
    assert 10 < inside.sum() < 990
    np.testing.assert_allclose(chance[inside] / size[inside], chance[inside][0] / size[inside][0])


def test_a_rendered_test_set_has_the_error_of_a_plain_one(tmp_path: Path) -> None:
    """Means and errors of a model agree, and the test set by highlights, the default of a glossy material,
    resolves the error far better. Few queries, and those of a matte material, are plain."""
    np.save(tmp_path / "height.npy", 0.02 * np.random.default_rng(0).random((8, 8)))
    text = "height: height.npy\nbase_color: 0.8\nmetallic: 1\nroughness: 0.4\n"
    (tmp_path / "material.yaml").write_text(text)
    found: list[tuple[Estimate, Estimate]] = []

    def data_of(name: str, **queries: Any) -> Dataset:
        options = {"train": "16", "test": "8192", "test_spp": 16, **queries}
        config = GeneratorConfig(material=str(tmp_path), queries=options, output={"shard_queries": 4096})
        generate(config, tmp_path / name)
        return Dataset.open(tmp_path / name)

    for name, options in (("plain", {"test_highlights": 0}), ("drawn", {})):
        data = data_of(name, **options)
        assert data.weighted == (name == "drawn")
        test = data.load("test")
        assert (test["spp"] == 16).all()
        assert "weight" not in data.load("train")
        a, b, w = test["value_a"], test["value_b"], test.get("weight")
        model = value_of(Queries(*(test[k] for k in ("u", "sigma", "omega_i", "omega_o"))), 0.3)
        prediction = np.repeat(model[:, None], 3, 1)
        found.append((mean_estimate((a + b) / 2, w), unexplained_variance(prediction, a, b, w)))
    for plain, drawn in zip(*found, strict=True):
        assert t_test(plain, drawn).p_value > 1e-3
    assert found[1][1].error < 0.4 * found[0][1].error
    assert not data_of("few", test="4096").weighted
    (tmp_path / "material.yaml").write_text("height: height.npy\nbase_color: 0.8\n")
    assert not data_of("matte").weighted
