"""Resampling keeps means, places and wrap; dequantization removes terraces and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.height_maps import Floats, fractal, rms, slopes

from mbtf_core.data.lattice import texel_centers
from mbtf_core.images.resample import dequantize, resample

SIZES = st.integers(1, 13)


def noise(rows: int, columns: int, channels: int | None = None) -> Floats:
    shape = (rows, columns) if channels is None else (rows, columns, channels)
    return np.random.default_rng(rows * 100 + columns).normal(size=shape)


def wave(rows: int, columns: int) -> Floats:
    """A smooth periodic function of uv at the texel centers; it looks different under any flip or swap."""
    uv = texel_centers(rows, columns)
    return np.sin(2 * np.pi * uv[..., 0] + 0.3) + 0.5 * np.cos(
        2 * np.pi * (uv[..., 1] - 2 * uv[..., 0]) + 0.7
    )


@given(SIZES, SIZES, SIZES, SIZES)
@settings(max_examples=60, deadline=None)
def test_reduction_preserves_the_mean_and_constants(rows: int, columns: int, r: int, c: int) -> None:
    image = noise(rows, columns)
    out = resample(image, min(r, rows), min(c, columns))
    assert out.mean() == pytest.approx(image.mean(), abs=1e-12)
    assert out.max() <= image.max() + 1e-12
    assert resample(np.full((rows, columns), 0.3), r, c) == pytest.approx(0.3, abs=1e-12)


@pytest.mark.parametrize(
    ("rows", "columns", "enlarge", "tolerance"),
    [
        (64, 64, "linear", 0.02),
        (64, 64, "cubic", 0.002),
        (77, 50, "cubic", 0.002),
        (16, 16, "linear", 0.04),
        (11, 24, "linear", 0.05),
    ],
)
def test_nothing_shifts(rows: int, columns: int, enlarge: str, tolerance: float) -> None:
    """A function of uv stays that function: texel centers follow one rule at every resolution."""
    out = resample(wave(32, 48), rows, columns, enlarge)  # type: ignore[arg-type]
    assert np.abs(out - wave(rows, columns)).max() < tolerance
    shifted = np.roll(wave(rows, columns), 1, axis=1)
    assert np.abs(out - shifted).max() > 2 * tolerance


STEP = 1.0 / 255.0


def quantized(height: Floats) -> Floats:
    return np.rint(height / STEP) * STEP


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 2.5, 3.0])
def test_detail_is_never_worse_than_stored(exponent: float) -> None:
    """From rough maps, where nothing can be gained, to smooth ones."""
    truth = fractal(256, 256, exponent)
    stored = quantized(truth)
    out = dequantize(stored, STEP)
    assert rms(out - truth) < 1.01 * rms(stored - truth)
    assert rms(slopes(out) - slopes(truth)) < 1.01 * rms(slopes(stored) - slopes(truth))


@pytest.mark.parametrize(
    "make", [lambda: fractal(256, 256, 2.0), lambda: (noise(64, 48) > 0).astype(float), lambda: noise(9, 1)]
)
def test_no_height_leaves_its_half_step(make: object) -> None:
    stored = quantized(make())  # type: ignore[operator]
    assert np.abs(dequantize(stored, STEP) - stored).max() <= 0.5 * STEP * (1 + 1e-12)


def test_dequantization_is_periodic_and_keeps_constants() -> None:
    stored = quantized(fractal(256, 256, 2.5))
    rolled = np.roll(stored, (37, 101), axis=(0, 1))
    assert dequantize(rolled, STEP) == pytest.approx(
        np.roll(dequantize(stored, STEP), (37, 101), (0, 1)), abs=1e-4 * STEP
    )
    for shape in ((4, 5), (1, 1), (256, 256)):
        assert np.array_equal(dequantize(np.full(shape, 77 * STEP), STEP), np.full(shape, 77 * STEP))
    with pytest.raises(ValueError, match="positive"):
        dequantize(stored, 0.0)
