"""FLIP: zero for equal images, known for uniform ones, dependent on exposure and white point."""

from __future__ import annotations

import numpy as np
import pytest

from mbtf_pipeline.compare.perceptual_metrics import flip

Color = tuple[float, float, float]


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


def uniform(color: Color) -> np.ndarray:
    return np.broadcast_to(np.array(color, np.float32), (40, 48, 3)).copy()


def hunt(color: np.ndarray) -> np.ndarray:
    """CIELAB of linear Rec.709 under its own white, chroma scaled by lightness (Andersson et al. 2020)."""
    red, green = (10135552, 8788810, 4435075), (2613072, 8788810, 887015)
    blue = (1425312, 8788810, 70074185)
    to_xyz = np.array([red, green, blue]) / np.array([[24577794], [12288897], [73733382]])
    x = to_xyz @ color / (to_xyz @ np.ones(3))
    bend = 6 / 29
    f = np.where(x > bend**3, np.cbrt(x), x / (3 * bend**2) + 4 / 29)
    light = 116 * f[1] - 16
    return np.array([light, 0.01 * light * 500 * (f[0] - f[1]), 0.01 * light * 200 * (f[1] - f[2])])


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """FLIP of two uniform images: without edges and texture only the redistributed HyAB distance remains."""

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        d = hunt(a) - hunt(b)
        return float((abs(d[0]) + np.hypot(d[1], d[2])) ** 0.7)

    largest = distance(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    share = distance(first, second) / largest
    return 0.95 * share / 0.4 if share < 0.4 else 0.95 + 0.05 * (share - 0.4) / 0.6


def aces(x: np.ndarray) -> np.ndarray:
    """The tone mapper of HDR-FLIP (Narkowicz's fit, 0.6 before it), clipped at 1."""
    y = 0.6 * x
    return np.clip(y * (2.51 * y + 0.03) / (y * (2.43 * y + 0.59) + 0.14), 0, 1)


@pytest.mark.parametrize(
    ("first", "second"),
    [((0.2, 0.3, 0.1), (0.25, 0.3, 0.1)), ((0.05, 0.05, 0.05), (0.6, 0.1, 0.02)), ((0, 0, 0), (0.9, 1, 0.8))],
)
def test_flip_of_uniform_images_is_known(first: Color, second: Color) -> None:
    white = 0.5
    found = flip(uniform(first), uniform(second), white)
    shown = [np.array(c) / white for c in (first, second)]
    assert found.ldr == pytest.approx(apart(*(np.minimum(c, 1) for c in shown)), rel=2e-3)
    exposed = [[aces(2.0**stop * c) for c in shown] for stop in (-2, 0, 2)]
    assert found.hdr == pytest.approx(max(apart(*pair) for pair in exposed), rel=2e-3)
