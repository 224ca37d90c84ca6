"""The model `svbrdf` recovers the parameters of surfaces that it can describe, and stays stable where it
cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.fit_data import F32, write_data

from mbtf_core.data.dataset import Dataset
from mbtf_fit.config import FitConfig
from mbtf_fit.training.fit import fit

BASE_COLOR = np.array([0.6, 0.3, 0.1])


def brdf(omega_i: F32, omega_o: F32, metallic: float, roughness: float) -> NDArray[np.float64]:
    """A plane of the metallic workflow (Burley 2012), by the formulas of Walter et al. 2007: D·G·F / (4 cos
    cos), separable masking and shadowing."""
    half = omega_i.astype(np.float64) + omega_o
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    alpha2 = roughness**4
    d = alpha2 / (np.pi * (half[:, 2] ** 2 * (alpha2 - 1) + 1) ** 2)
    f0 = metallic * BASE_COLOR + 0.04 * (1 - metallic)
    schlick = (1 - np.sum(half * omega_o, axis=1))[:, None] ** 5
    fresnel = f0 + (1 - f0) * schlick
    shadow = 1.0
    for omega in (omega_i, omega_o):
        cos = omega[:, 2].astype(np.float64)
        shadow = shadow * 2 * cos / (cos + np.sqrt(alpha2 + (1 - alpha2) * cos**2))
    specular = fresnel * (d * shadow / (4 * omega_i[:, 2] * omega_o[:, 2]))[:, None]
    return (1 - metallic) * BASE_COLOR / np.pi + specular


@pytest.mark.parametrize(("metallic", "roughness"), [(0.0, 0.5), (1.0, 0.4)])
def test_a_plane_is_recovered(metallic: float, roughness: float, tmp_path: Path) -> None:
    shards = write_data(
        tmp_path / "shards", lambda *at: brdf(*at[2:], metallic, roughness), train=4000, test=1000, finest=1
    )
    training = {"steps": 400, "batch": 1000, "texture_learning_rate": 0.2}
    config = FitConfig.model_validate({"model": "svbrdf", "training": training, "device": "cpu"})
    weights = fit(config, shards, tmp_path / "material").material.model.weights()
    # Engines have no calibration factors.
    assert "calibration" not in weights
    texels = np.concatenate([w.reshape(-1, 8) for name, w in weights.items() if "features" in name])
    texels[:, 4:7] *= 0.3
    found = 1 / (1 + np.exp(-texels[:, :5]))
    assert found == pytest.approx(np.tile([*BASE_COLOR, metallic, roughness], (len(found), 1)), abs=0.1)
    assert np.abs(texels[:, 5:7]).max() < 0.02


def test_highlights_that_the_surface_shadows_leave_no_spikes(tmp_path: Path) -> None:
    """A glossy surface whose relief shadows it towards grazing angles, which one lobe cannot describe, at 400
    queries per texel: better than a constant, and without highlights that the surface does not have.
    """

    def shadowed(u: F32, sigma: F32, omega_i: F32, omega_o: F32) -> NDArray[np.float64]:
        return brdf(omega_i, omega_o, 0.0, 0.35) * (omega_i * omega_o)[:, 2:]

    shards = write_data(tmp_path / "shards", shadowed, train=2000, test=4000, finest=1)
    training = {"steps": 200, "batch": 1000}
    config = FitConfig.model_validate({"model": "svbrdf", "training": training, "device": "cpu"})
    result = fit(config, shards, tmp_path / "material")
    assert result.errors["test"]["unexplained"]["value"] < 0.95
    q = Dataset.open(shards).load("test")
    found = result.material.evaluate(q["u"], q["sigma"], q["omega_i"], q["omega_o"])
    assert found.max() < 2 * q["value_a"].max()
