"""A homogeneous plane: M is the BRDF averaged over the light kernel, at every query."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import direction, estimate, flat, mi, queries

from mbtf_core.stats import mean_of_halves, t_test
from mbtf_gen.sampling.light_kernel import LightKernel


def kernel_average(
    bsdf: Any, omega_i: NDArray[np.float64], omega_o: NDArray[np.float64], width: float
) -> float:
    """∫ f p ω_z⁺ dω / ∫ p ω_z⁺ dω on a polar grid about ω_i, with the lobe's definition written out anew."""
    from mbtf_gen.sampling.light_kernel import concentration

    kappa = concentration(width)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    end = min(np.pi, np.sqrt(60.0 / kappa))
    theta = 0.5 * end * (nodes + 1)
    phi = 2 * np.pi * (np.arange(360) + 0.5) / 360
    t, p = np.meshgrid(theta, phi, indexing="ij")
    w = np.broadcast_to(
        (weights * 0.5 * end * np.sin(theta) * np.exp(-2 * kappa * np.sin(theta / 2) ** 2))[:, None], t.shape
    )
    axis = np.cross(omega_i, [0.0, 1.0, 0.0])
    axis /= np.linalg.norm(axis)
    other = np.cross(omega_i, axis)
    omega = (
        np.cos(t)[..., None] * omega_i
        + (np.sin(t) * np.cos(p))[..., None] * axis
        + (np.sin(t) * np.sin(p))[..., None] * other
    ).reshape(-1, 3)
    weight = np.where(omega[:, 2] > 0, w.ravel(), 0.0)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f([float(c) for c in omega_o])
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(omega.T.astype(np.float32).copy())))[0]
    # Mitsuba's eval includes the cosine of the light.
    return float(np.sum(weight * value) / np.sum(weight * np.maximum(omega[:, 2], 0)))


ROUGH = {"type": "roughconductor", "alpha": 0.3, "distribution": "ggx", "material": "none"}
GRAY = {"type": "rgb", "value": [0.6, 0.6, 0.6]}
PRINCIPLED = {"type": "principled", "base_color": GRAY, "roughness": 0.35, "metallic": 0.4, "specular": 0.5}


@pytest.mark.parametrize("description", [ROUGH, PRINCIPLED], ids=["roughconductor", "principled"])
@pytest.mark.parametrize("width", [1.0, 10.0])
@pytest.mark.parametrize(("light", "view"), [(60, 50), (25, 30), (0.8, 20), (5, 5)])
def test_glossy_kernel_average(description: dict[str, Any], width: float, light: float, view: float) -> None:
    omega_i, omega_o = direction(light, 10), direction(view, 175)
    expected = kernel_average(mi.load_dict(description), omega_i, omega_o, width)
    e = estimate(
        flat(), description, LightKernel(width), queries([0.3, 0.7], 0.1, omega_i, omega_o, 2000), 64
    )
    mean = mean_of_halves(e.value_a[:, 0], e.value_b[:, 0])
    assert mean.relative_error < 1e-2
    assert t_test(mean, expected).p_value > 1e-4
