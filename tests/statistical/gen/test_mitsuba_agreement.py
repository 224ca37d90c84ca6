"""Unmodified Mitsuba gives the same values: a block of instanced tiles under its ``path`` integrator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.mitsuba_blocks import GRIDS, SPP, block, mitsuba_halves, random_queries
from support.scenes import LightKernel, Transport, direction, directional, estimate, mi, real_heights
from support.significance import aggregate_test

from mbtf_core.stats import elevation_groups
from mbtf_gen.tile.heights import HeightGrid


def colors(shape: tuple[int, int] = (16, 16)) -> dict[str, Any]:
    """A Lambert reflector with a random color map, which detects flips and shifts."""
    pixels = np.random.default_rng(12).random((*shape, 3)).astype(np.float32)
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}


def heights(name: str) -> HeightGrid:
    """A synthetic height field, square or wide, or that of a material."""
    return GRIDS[name] if name in GRIDS else real_heights(name)


@pytest.mark.parametrize("shape", ["wide", "turtle_shell", "rock_cliff"])
@pytest.mark.parametrize("depth", [1, 4], ids=["direct", "interreflection"])
@pytest.mark.parametrize("sigma", [1e-6, 0.3], ids=["point", "wide"])
def test_mitsuba_agrees(shape: str, depth: int, sigma: float, tmp_path: Path) -> None:
    grid = heights(shape)
    bsdf = colors((8, 16) if shape == "wide" else (16, 16))
    omega_i = direction(40, 70)
    q = random_queries(4096, sigma, omega_i)
    # Mitsuba's depth counts the emitter's vertex too. Unit irradiance on the plane.
    a, b = mitsuba_halves(block(grid, bsdf, tmp_path), directional(omega_i), q, grid.aspect, depth + 1)
    transport = Transport(max_depth=depth, roulette_depth=1000)
    ours = estimate(grid, bsdf, LightKernel(0.0), q, SPP, transport=transport, seed=5)
    groups = elevation_groups(q.omega_o, edges=(0.0, 0.8, 1.0))
    result = aggregate_test(ours.value_a, ours.value_b, a, b, groups)
    # Mitsuba's rays leave a surface 5e-5 tile widths above it, ours 3e-7. Where point queries have next to no
    # noise, the light that slips past shadow edges shows: up to two thousandths of the mean.
    mean = float(ours.value_a.mean())
    allowed = {"mean": 2e-3 * mean, "scatter": 2e-3 * mean**2}
    for c in result.comparisons:
        assert c.corrected > 1e-3 or abs(c.estimate.value) < allowed[c.kind], str(result)
    assert mean > 0.02


def test_smoothed_emitter_in_mitsubas_integrator_agrees(tmp_path: Path) -> None:
    """The registered emitter gives each query its own smoothed light under Mitsuba's integrator."""
    grid = GRIDS["square"]
    q = random_queries(4096, 0.05)
    emitter = {"type": "mbtf_directional", "width": 5.0}
    a, b = mitsuba_halves(block(grid, colors(), tmp_path), emitter, q, 1.0, 3)
    transport = Transport(max_depth=2, roulette_depth=1000)
    ours = estimate(grid, colors(), LightKernel(5.0), q, SPP, transport=transport, seed=5)
    groups = elevation_groups(q.omega_i, edges=(0.0, 0.8, 1.0))
    result = aggregate_test(ours.value_a, ours.value_b, a, b, groups)
    assert result.p_value > 1e-3, str(result)
