"""Uniform cubic B-splines that repeat with the tile."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline

from mbtf_gen.tile.fibers.curves import Bundle, Curve, closed_frames, level_frames

SHIFT = np.array([1.0, 0.0, 0.0])


def wavy(n: int = 12, seed: int = 0, shift: np.ndarray = SHIFT) -> Curve:
    """A closed curve that leaves the tile on several sides."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([np.zeros(n), 0.9 + 0.3 * rng.random(n), 0.1 * rng.random(n)])
    return Curve.through(points + np.arange(n)[:, None] / n * shift, 0.01, shift)


def test_positions_and_derivatives_are_those_of_the_b_spline() -> None:
    control = np.random.default_rng(2).random((7, 4))
    spline = BSpline(np.arange(-3.0, 8.0), control, 3)
    t = np.linspace(0.0, 4.0, 41)
    at, slope = Curve(control).at(t)
    assert np.abs(at - spline(t)).max() < 1e-12
    assert np.abs(slope - spline.derivative()(t)).max() < 1e-11


@pytest.mark.parametrize("kind", ["closed", "two periods", "diagonal", "open"])
@pytest.mark.parametrize("aspect", [1.0, 0.6])
def test_copies_cover_the_box_exactly(aspect: float, kind: str) -> None:
    shift = {"two periods": np.array([2.0, 0, 0]), "diagonal": np.array([1.0, aspect, 0.0])}.get(kind, SHIFT)
    curve = wavy(shift=shift)
    if kind == "open":
        curve = Curve(curve.unrolled())
    runs, _ = Bundle([curve]).copies((1.0, aspect))
    segments = np.concatenate(
        [np.lib.stride_tricks.sliding_window_view(run, 4, axis=0).transpose(0, 2, 1) for run in runs]
    )
    middles = np.einsum("k,mkc->mc", [1 / 48, 23 / 48, 23 / 48, 1 / 48], segments)
    # Every point of the endless curve that lies in the box is the middle of exactly one segment there.
    position = curve.at(np.arange(12) + 0.5)[0][:, :3]
    for i in range(-3, 4):
        for j in range(-4, 5):
            moved = position + np.array([i, j * aspect, 0.0])
            inside = (moved[:, 0] > 0) & (moved[:, 0] < 1) & (moved[:, 1] > 0) & (moved[:, 1] < aspect)
            for point in moved[inside]:
                assert np.count_nonzero(np.abs(middles[:, :3] - point).max(axis=1) < 1e-12) == 1
    # No segment is listed that stays outside.
    low = segments[:, :, :2].min(axis=1) - segments[:, :, 3].max(axis=1)[:, None]
    high = segments[:, :, :2].max(axis=1) + segments[:, :, 3].max(axis=1)[:, None]
    assert (high >= 0).all()
    assert (low <= (1.0, aspect)).all()


def test_frames_close_and_turn_little() -> None:
    curve = wavy(64)
    slope = curve.at(np.arange(64.0))[1][:, :3]
    tangent = slope / np.linalg.norm(slope, axis=1)[:, None]
    for normal, binormal in (closed_frames(tangent), level_frames(tangent)):
        frame = np.stack([tangent, normal, binormal], axis=1)
        assert np.abs(frame @ frame.transpose(0, 2, 1) - np.eye(3)).max() < 1e-12
        assert np.abs(np.linalg.det(frame) - 1.0).max() < 1e-12
        # The step from the last frame to the first is no larger than the others.
        step = np.linalg.norm(np.roll(normal, -1, axis=0) - normal, axis=1)
        assert step[-1] <= 1.5 * step[:-1].max()


@pytest.mark.parametrize("closed", [True, False])
def test_a_halved_curve_is_the_same(closed: bool) -> None:
    curve = wavy(7) if closed else Curve(np.random.default_rng(4).random((9, 4)))
    fine = curve.halved()
    t = np.linspace(0.0, len(curve.windows()), 100)
    assert len(fine.windows()) == 2 * len(curve.windows())
    assert np.abs(fine.at(2.0 * t)[0] - curve.at(t)[0]).max() < 1e-12
