"""Directions: projected disk, angles, bands."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_core.directions import check_unit, from_angles, from_projected_disk
from mbtf_core.errors import InputError


def test_axes() -> None:
    """Azimuth counts from +u towards +v."""
    assert from_angles(0, 0) == pytest.approx([1, 0, 0], abs=1e-15)
    assert from_angles(0, 90) == pytest.approx([0, 1, 0], abs=1e-15)
    assert from_angles([90, 90], [10, 200]) == pytest.approx(np.array([[0, 0, 1], [0, 0, 1]]), abs=1e-15)
    assert from_angles(np.zeros((2, 1)), np.zeros(3)).shape == (2, 3, 3)
    assert np.linalg.norm(from_angles(33.0, 123.0)) == pytest.approx(1.0)
    # Grazing elevations keep their precision.
    assert from_angles(1e-6, 45.0)[2] == pytest.approx(np.radians(1e-6), rel=1e-9)


def test_directions_that_are_no_unit_vectors_are_refused() -> None:
    good = from_angles([10.0, 45.0, 90.0], [0.0, 120.0, -30.0])
    check_unit(good, "omega_i")
    check_unit(good.astype(np.float16), "omega_i")
    for factor in (5.0, 0.99, 0.0, np.nan):
        bad = good.copy()
        bad[1] *= factor
        with pytest.raises(InputError, match=r"omega_i: 1 of 3 directions are not .* at index 1"):
            check_unit(bad, "omega_i")


@pytest.mark.parametrize("radius", [0.0, 0.5, 0.99, 1.0])
def test_projected_disk(radius: float) -> None:
    omega = from_projected_disk([radius * 0.6, radius * -0.8])
    assert omega[:2] == pytest.approx([radius * 0.6, radius * -0.8])
    assert np.linalg.norm(omega) == pytest.approx(1.0)
    # Rounding beyond the disk gives no NaN.
    assert from_projected_disk([1.0 + 1e-12, 0.0])[2] == 0.0
