"""A measured BTF of a known function, in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.measured.interface import F32
from mbtf_gen.sampling.query_sampler import direction_pairs, slice_directions


def known(u: NDArray[np.floating], omega_i: F32, omega_o: F32) -> F32:
    """M (n, 3) that tells positions, light, view and colors apart; positive."""
    value = 0.3 + 0.1 * np.sin(2 * np.pi * u[:, 0]) + 0.05 * np.cos(2 * np.pi * u[:, 1])
    value = value + 0.1 * omega_i[:, 0] + 0.05 * omega_o[:, 1]
    return np.asarray(value[:, None] * np.array([1.0, 0.7, 0.4]), np.float32)


class Images:
    """Images of :func:`known`, times the cosine of the light."""

    at_once = 700

    def __init__(self, rows: int = 6, columns: int = 12, lights: int = 8) -> None:
        self.rows, self.columns = rows, columns
        self.light, self.view = direction_pairs(slice_directions("spiral", lights, 0.05))
        self.left_out = 3
        self.cosine: bool | None = True
        self.calls = 0

    def values(self, pair: NDArray[np.int64], texel: NDArray[np.int64]) -> F32:
        self.calls += 1
        j, i = np.divmod(texel, self.columns)
        u = np.stack([(i + 0.5) / self.columns, 1.0 - (j + 0.5) / self.rows], -1)
        return known(u, self.light[pair], self.view[pair]) * self.light[pair, 2:]


class Listed:
    """Random queries of :func:`known`."""

    def __init__(self, count: int = 1000) -> None:
        random = np.random.default_rng(0)
        self.count = count
        omega = slice_directions("spiral", 50, 0.2)
        self.arrays = {
            "u": random.random((count, 2), np.float32),
            "sigma": np.full(count, 0.5 / 16, np.float32),
            "omega_i": omega[random.integers(50, size=count)],
            "omega_o": omega[random.integers(50, size=count)],
        }
        self.arrays["value"] = known(self.arrays["u"], self.arrays["omega_i"], self.arrays["omega_o"])

    def read(self, start: int, stop: int) -> Any:
        return {name: a[start:stop].copy() for name, a in self.arrays.items()}
