"""Levels of detail: texels and footprints."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mbtf_core.data.lattice import Lattice, level_of_sigma, sigma_of_level, texel_centers


def test_footprint_of_a_level_is_half_a_texel() -> None:
    assert sigma_of_level(0) == 0.5
    assert sigma_of_level([0, 1, 7]) == pytest.approx([0.5, 0.25, 0.5 / 128])


@given(st.floats(-5, 20))
def test_level_and_footprint_are_inverse(level: float) -> None:
    assert level_of_sigma(sigma_of_level(level)) == pytest.approx(level, abs=1e-12)


@pytest.mark.parametrize(
    ("rows", "columns", "finest", "shape"),
    [
        (128, 128, 7, (128, 128)),
        (512, 1024, 10, (512, 1024)),
        (1024, 512, 9, (1024, 512)),
        (1, 1, 0, (1, 1)),
        (100, 100, 6, (64, 64)),
        (300, 1000, 9, (154, 512)),
        (1, 1000, 9, (1, 512)),
    ],
)
def test_default_lattice_of_a_map(rows: int, columns: int, finest: int, shape: tuple[int, int]) -> None:
    lattice = Lattice.for_map(rows, columns)
    assert lattice.finest == finest
    assert lattice.shape() == shape
    assert lattice.texels() == shape[0] * shape[1]
    assert lattice.shape(0) == (max(1, round(rows / columns)), 1)


def test_texel_centers() -> None:
    """Row 0 is the side v → 1; centers are half a texel from the edges."""
    centers = texel_centers(4, 8)
    assert centers.shape == (4, 8, 2)
    assert centers[0, 0] == pytest.approx([0.5 / 8, 1 - 0.5 / 4])
    assert centers[3, 7] == pytest.approx([1 - 0.5 / 8, 0.5 / 4])
    assert centers.mean(axis=(0, 1)) == pytest.approx([0.5, 0.5])
