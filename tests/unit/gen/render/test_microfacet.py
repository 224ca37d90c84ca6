"""GGX facets and their energy tables, against textbook formulas integrated in double precision."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import mi
from support.surfaces import sobol, vectors

from mbtf_gen.render.bsdf.microfacet import (
    MIRROR_ALPHA,
    EnergyTables,
    distribution,
    half_tangent2,
    missing_energy_pdf,
    sample_missing_energy,
    smith,
)

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def tables() -> EnergyTables:
    return EnergyTables()


def ggx_energy(cosine: float, alpha: float, fresnel: bool, count: int = 1 << 16) -> float:
    """∫ F D G2/(4 μi μo) μo dωo of a GGX lobe, F being 1 or (1-cosθd)⁵, over facets of density D cosθ.

    Walter et al. 2007, with Smith's height-correlated G2 as in Heitz 2014, written with tangents.
    """
    xi = sobol(count, 2, seed=4).astype(np.float64)
    tangent = alpha * np.sqrt(xi[:, 0] / (1 - xi[:, 0]))
    phi = 2 * np.pi * xi[:, 1]
    z = 1 / np.sqrt(1 + tangent**2)
    h = np.stack([tangent * z * np.cos(phi), tangent * z * np.sin(phi), z], axis=-1)
    wi = np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    d = h @ wi
    wo = 2 * d[:, None] * h - wi
    seen = (d > 0) & (wo[:, 2] > 0)

    def capital_lambda(c: Array) -> Array:
        return (np.sqrt(1 + alpha**2 * (1 - c**2) / c**2) - 1) / 2

    g2 = 1 / (1 + capital_lambda(np.array(cosine)) + capital_lambda(np.where(seen, wo[:, 2], 1.0)))
    f = (1 - d) ** 5 if fresnel else 1.0
    return float(np.mean(np.where(seen, f * g2 * d / (cosine * z), 0.0)))


@pytest.mark.parametrize("roughness", [0.0033, 0.0101, 0.02, 0.047, 0.1, 0.3, 0.5, 0.77, 1.0])
def test_tables_hold_what_facets_reflect(tables: EnergyTables, roughness: float) -> None:
    """Between nodes too. The tables' own error is 8e-4 at most, at μ ~ α of the smoothest lobes."""
    alpha = max(roughness**2, MIRROR_ALPHA)
    cosines = [1.0, 0.7, 0.31, 0.1, *(c for c in (3.0 * alpha, alpha) if c < 0.1)]
    lost, grazing = (np.array(x) for x in tables.at(mi.Float(cosines), mi.Float(roughness)))
    for c, one, other in zip(cosines, lost, grazing, strict=True):
        assert abs(1 - one - ggx_energy(c, alpha, False)) < 1.5e-3, c
        assert abs(other - ggx_energy(c, alpha, True)) < 1.5e-3, c


def test_averages_are_those_of_the_tables_between_rows_too(tables: EnergyTables) -> None:
    x, w = np.polynomial.legendre.leggauss(400)
    # Cosines down to 1e-6 on a logarithmic scale: all is lost at μ ~ α.
    log = 0.5 * (x + 1) * np.log(1e6) - np.log(1e6)
    cosine, measure = np.exp(log), 0.5 * w * np.log(1e6) * 2 * np.exp(2 * log)
    for roughness in np.random.default_rng(3).uniform(0.0035, 1.0, 6):
        mean = [float(np.array(v)[0]) for v in tables.average(mi.Float(float(roughness)))]
        for k, value in enumerate(tables.at(mi.Float(cosine), mi.Float(float(roughness)))):
            assert mean[k] == pytest.approx(float(np.sum(np.array(value) * measure)), rel=3e-3)


@pytest.mark.parametrize("roughness", [0.0, 0.001, 0.00316])
def test_a_mirror_loses_nothing(tables: EnergyTables, roughness: float) -> None:
    cosine = np.array([1.0, 0.3, 1e-2, 1e-4, 1e-6], np.float32)
    lost, grazing = tables.at(mi.Float(cosine), mi.Float(roughness))
    assert np.all(np.array(lost) == 0)
    np.testing.assert_allclose(np.array(grazing), (1 - cosine.astype(np.float64)) ** 5, atol=1e-6)


@pytest.mark.parametrize("alpha", [1e-5, 1e-2, 0.3, 1.0])
def test_masking_keeps_its_digits(alpha: float) -> None:
    cosine = np.array([1 - 1e-6, 0.9, 0.1, 1e-3, 1e-6])
    x = alpha**2 * (1 - cosine**2) / cosine**2
    expected = 0.5 * np.expm1(0.5 * np.log1p(x))
    np.testing.assert_allclose(np.array(smith(mi.Float(cosine), alpha)), expected, rtol=5e-2, atol=0)
    np.testing.assert_allclose(np.array(smith(mi.Float(cosine[1:]), alpha)), expected[1:], rtol=1e-5)


@pytest.mark.parametrize("alpha", [1e-5, 0.05, 0.6, 1.0])
def test_distribution_fills_the_projected_plane(alpha: float) -> None:
    """∫ D cosθ dω = 1, over slopes: tanθ = t α/(1-t)."""
    x, w = np.polynomial.legendre.leggauss(200)
    t = 0.5 * (x + 1)
    tangent = alpha * t / (1 - t)
    z = 1 / np.sqrt(1 + tangent**2)
    # dω = sinθ dθ dφ = tanθ cos³θ dtanθ dφ
    measure = 0.5 * w * alpha / (1 - t) ** 2 * tangent * z**3 * 2 * np.pi
    density = np.array(distribution(mi.Float(tangent**2), mi.Float(alpha)), np.float64)
    assert np.sum(density * z * measure) == pytest.approx(1.0, rel=2e-5)


@pytest.mark.parametrize("cosine", [0.9999, 0.7, 0.1, 1e-2])
def test_half_vectors_keep_the_digits_of_narrow_lobes(cosine: float) -> None:
    """Slopes of 1e-5 and less, of directions in single precision: their noise is of the order of its last
    digit over the cosine across the plane of incidence, and without that factor within."""
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


def test_samples_of_missing_energy_have_its_density() -> None:
    """Quantiles of sampled cosines are those of the integrated density; azimuths are even."""
    for alpha in (1e-5, 1e-2, 0.3, 1.0):
        w = np.array(sample_missing_energy(mi.Float(alpha), mi.Point2f(sobol(1 << 12, 2).T)), np.float64)
        np.testing.assert_allclose(np.linalg.norm(w, axis=0), 1.0, atol=1e-6)
        assert np.all(np.abs(w[:2].mean(axis=1)) < 2e-3)
        log = np.linspace(np.log(1e-7), 0, 200_001)
        pdf = np.array(missing_energy_pdf(mi.Float(np.exp(log)), mi.Float(alpha)), np.float64)
        cumulative = np.cumsum(2 * np.pi * pdf * np.exp(log)) * (log[1] - log[0])
        assert cumulative[-1] == pytest.approx(1.0, abs=1e-3)
        for q in (0.1, 0.5, 0.9):
            at = np.interp(q, cumulative, log)
            assert np.mean(np.log(w[2]) < at) == pytest.approx(q, abs=3e-3)
