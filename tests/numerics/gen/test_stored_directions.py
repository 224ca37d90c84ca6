"""Directions survive npz and EXR to 1e-6 rad everywhere, and cosines to 1e-6 of themselves."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.surfaces import towards

from mbtf_core.data.shard_files import read_shard, write_shard

N = 3000


def stored(omega: NDArray[np.float64], suffix: str) -> NDArray[np.float64]:
    """Directions of light and view as read back from a shard."""
    n = len(omega)
    o = omega.astype(np.float32)
    value = np.ones((n, 3), np.float32)
    arrays = {"u": np.zeros((n, 2), np.float32), "omega_i": o, "omega_o": o[::-1].copy()}
    arrays |= {"value_a": value, "value_b": value}
    arrays |= {name: np.ones(n, np.float32) for name in ("sigma", "spp")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"train-00000{suffix}")
        write_shard(path, arrays)
        back = {k: np.array(v, np.float64) for k, v in read_shard(path, mapped=False).items()}
    assert np.array_equal(back["omega_o"][::-1], back["omega_i"])
    return back["omega_i"]


@pytest.mark.parametrize("suffix", [".npz", ".exr"])
@settings(max_examples=8)
@given(st.floats(-9.0, 0.0), st.floats(0.0, 360.0), st.integers(0, 1000))
def test_directions_survive(suffix: str, lowest: float, azimuth: float, seed: int) -> None:
    """Within 1e-6 rad and 1e-6 of the cosine, from the pole to 1e-9 above the horizon."""
    rng = np.random.default_rng(seed)
    cosine = 10 ** rng.uniform(lowest, 0, N)
    cosine[:2] = 1.0, 10**lowest
    omega = towards(cosine, azimuth + rng.uniform(0, 360, N))
    back = stored(omega, suffix)
    angle = 2 * np.arcsin(0.5 * np.linalg.norm(back - omega, axis=1))
    assert angle.max() < 1e-6
    np.testing.assert_allclose(back[:, 2], omega[:, 2], rtol=1e-6)
