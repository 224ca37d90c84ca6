"""The model `svbrdf` recovers what it can describe; shading frames of `zeltner2024`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.fit_data import F32, write_data

from mbtf_core.data.dataset import Dataset
from mbtf_fit import ops
from mbtf_fit.config import FitConfig
from mbtf_fit.pytorch.operations import PYTORCH
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


def test_directions_are_read_in_the_frame_of_normal_and_tangent() -> None:
    """A frame built the other way round, by turning the tile's, gives back its own axes as x, y and z."""
    generator = torch.Generator().manual_seed(0)
    angles = torch.rand((100, 3), generator=generator, dtype=torch.float64) - 0.5
    # The frames: the tile's, turned about z by at most half a radian, then about y, then about x.
    frames = torch.eye(3, dtype=torch.float64).expand(100, 3, 3)
    for (first, second), angle in zip(((0, 1), (2, 0), (1, 2)), angles.T, strict=True):
        turn = torch.eye(3, dtype=torch.float64).repeat(100, 1, 1)
        turn[:, first, first] = turn[:, second, second] = angle.cos()
        turn[:, second, first], turn[:, first, second] = angle.sin(), -angle.sin()
        frames = turn @ frames
    tangent, _, normal = frames.unbind(2)
    # Of any length, and the tangent with a part along the normal.
    a = 1.7 * normal - torch.tensor([0.0, 0.0, 1.0])
    b = 0.6 * (tangent + 0.8 * normal) - torch.tensor([1.0, 0.0, 0.0])
    operation = ops.ToFrame("local", "axes", "omega")
    for axis, expected in zip(frames.unbind(2), torch.eye(3, dtype=torch.float64), strict=True):
        local = cast(Any, PYTORCH[operation])(operation, None, torch.cat([a, b], 1), axis)
        torch.testing.assert_close(local, expected.expand(100, 3), rtol=0, atol=1e-12)
