"""FLIP: zero for equal images, known for uniform ones, dependent on exposure and white point."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_pipeline.compare.perceptual_metrics import flip

# A reference with a bright half, and a fit that differs only there: 4 or 5 times white.
REFERENCE, FIT = (np.repeat(np.array([0.05, bright], np.float32), 16) for bright in (0.8, 1.0))
REFERENCE, FIT = (np.broadcast_to(row[:, None], (24, 32, 3)) for row in (REFERENCE, FIT))


def test_equal_images_do_not_differ() -> None:
    found = flip(REFERENCE, REFERENCE, 0.2)
    assert found.ldr == found.hdr == 0
    assert not found.hdr_map.any()


def test_only_hdr_flip_responds_above_white() -> None:
    found = flip(FIT, REFERENCE, 0.2)
    assert found.ldr < 1e-6
    assert found.hdr > 0.01
    assert found.hdr_map.shape == (24, 32)
    assert found.hdr_map[:, 22:].mean() > 10 * found.hdr_map[:, :10].mean()
    assert found.hdr == pytest.approx(float(found.hdr_map.mean()), rel=1e-3)


def test_only_the_ratio_to_white_matters() -> None:
    assert flip(7 * FIT, 7 * REFERENCE, 1.4).hdr == pytest.approx(flip(FIT, REFERENCE, 0.2).hdr, rel=1e-4)
    assert flip(FIT, REFERENCE, 2.0).ldr > 0.01
