"""FLIP at stated exposures: none for equal pictures, and the exposures and the white point count."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_pipeline.flip import flip


@pytest.fixture(scope="module")
def pictures() -> tuple[np.ndarray, np.ndarray]:
    """A reference with a bright half, and a fit that is wrong there alone: 4 or 5 times white."""
    reference = np.full((24, 32, 3), 0.05, np.float32)
    reference[:, 16:] = 0.8
    fit = reference.copy()
    fit[:, 16:] = 1.0
    return fit, reference


def test_equal_pictures_do_not_differ(pictures: tuple[np.ndarray, np.ndarray]) -> None:
    found = flip(pictures[1], pictures[1], 0.2)
    assert found.ldr == found.hdr == 0
    assert not found.hdr_map.any()


def test_only_hdr_sees_what_is_cut_off_at_white(pictures: tuple[np.ndarray, np.ndarray]) -> None:
    found = flip(*pictures, 0.2)
    assert found.ldr < 1e-6
    assert found.hdr > 0.01
    assert found.hdr_map.shape == (24, 32)
    assert found.hdr_map[:, 22:].mean() > 10 * found.hdr_map[:, :10].mean()
    assert found.hdr == pytest.approx(float(found.hdr_map.mean()), rel=1e-3)


def test_only_the_ratio_to_white_counts(pictures: tuple[np.ndarray, np.ndarray]) -> None:
    fit, reference = pictures
    assert flip(7 * fit, 7 * reference, 1.4).hdr == pytest.approx(flip(fit, reference, 0.2).hdr, rel=1e-4)
    assert flip(fit, reference, 2.0).ldr > 0.01


def test_a_black_reference_has_a_number(pictures: tuple[np.ndarray, np.ndarray]) -> None:
    found = flip(pictures[0], np.zeros_like(pictures[1]), 0.2)
    assert 0 < found.hdr <= 1
