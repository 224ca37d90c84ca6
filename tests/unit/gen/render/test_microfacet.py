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
    half_tangent2,
    smith,
)

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def tables() -> EnergyTables:
    return EnergyTables()


def ggx_energy(cosine: float, alpha: float, fresnel: bool, count: int = 1 << 16) -> float:
    """∫ F D G2/(4 μi μo) μo dωo, F being 1 or (1-cosθd)⁵ (Walter et al. 2007, with G2 of Heitz 2014)."""
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
