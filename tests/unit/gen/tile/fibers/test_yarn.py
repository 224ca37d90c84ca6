"""Fibers of a yarn against the equations of the paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import kstest

from mbtf_gen.tile.fibers.curves import Curve
from mbtf_gen.tile.fibers.yarn import YARNS, CrossSection, YarnModel, _disk, fibers_of, roughness_of

# Sign of the angle from y to z along x of a fiber with a negative pitch.
TURNS = -1


def straight(n: int = 64) -> Curve:
    points = np.arange(n)[:, None] / n * np.array([1.0, 0.0, 0.0]) + (0.0, 0.5, 0.0)
    return Curve.through(points, 0.0, np.array([1.0, 0.0, 0.0]))


def plain(**changes: float) -> YarnModel:
    """Cotton without flyaways."""
    return replace(YARNS["cotton1"], loops=0.0, hairs=0.0, **changes)


def section(model: YarnModel, centimeters: float) -> CrossSection:
    """The yarn at a scale of so many centimeters per tile width."""
    half = model.radius / centimeters
    return CrossSection(half, half, True)


def cylinder(curve: Curve, count: int = 4000) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, z) around a straight yarn, at equal steps."""
    at = curve.at(np.linspace(0.0, len(curve.control), count))[0]
    return at[:, 0], at[:, 1] - 0.5, at[:, 2]


@pytest.mark.parametrize("name", ["cotton1", "rayon4", "silk2"])
def test_fibers_have_the_density_of_equation_1(name: str) -> None:
    model = replace(YARNS[name], fibers=4000)
    distance, angle = _disk(np.random.default_rng(0), model)

    def density(r: float) -> float:
        base = (np.e - np.exp(r)) / (np.e - 1.0)
        return r * ((1.0 - 2.0 * model.epsilon) * base**model.beta + model.epsilon)

    whole = quad(density, 0.0, 1.0)[0]
    grid = np.linspace(0.0, 1.0, 201)
    table = np.array([quad(density, 0.0, r)[0] for r in grid]) / whole
    assert kstest(distance, lambda r: np.interp(r, grid, table)).pvalue > 1e-3
    assert kstest(angle, "uniform", (-np.pi, 2.0 * np.pi)).pvalue > 1e-3


def test_plies_and_fibers_have_the_pitches_of_the_model() -> None:
    centimeters = 3.6
    model = plain(plies=1)
    fiber = fibers_of(straight(), section(model, centimeters), model, np.random.default_rng(1))[0]
    _, y, z = cylinder(fiber)
    # In the half axes of its ply, the fiber turns clockwise at 0.369 cm.
    angle = np.unwrap(np.arctan2(z / model.long_axis, y / model.short_axis))
    turns = (angle[-1] - angle[0]) / (2.0 * np.pi)
    # Seen along x, y points to the right and z up: clockwise turns have falling angles from y to z.
    assert turns == pytest.approx(TURNS * round(centimeters / 0.369), abs=0.01)
    # Many fibers of a ply have their mean on its center, which turns at 0.453 cm.
    model = plain(plies=2, fibers=200)
    fibers = fibers_of(straight(), section(model, centimeters), model, np.random.default_rng(2))
    at = np.mean([np.stack(cylinder(fiber)) for fiber in fibers[:200]], axis=0)
    angle = np.unwrap(np.arctan2(at[2], at[1]))
    turns = (angle[-1] - angle[0]) / (2.0 * np.pi)
    assert turns == pytest.approx(-TURNS * round(centimeters / 0.453), abs=0.05)
    distance = np.hypot(at[1], at[2]) * centimeters
    assert distance.mean() == pytest.approx(model.ply_distance, rel=0.05)


def test_fibers_migrate_between_r_min_and_r_max() -> None:
    model = plain(plies=1, migration=0.5, epsilon=0.0)
    fibers = fibers_of(straight(), section(model, 3.6), model, np.random.default_rng(3))
    for fiber in fibers[:10]:
        _, y, z = cylinder(fiber)
        scale = section(model, 3.6).width / model.radius
        distance = np.hypot(y / model.short_axis, z / model.long_axis) / scale
        assert distance.min() / distance.max() == pytest.approx(0.5, abs=0.03)
        assert distance.max() < 1.01


@pytest.mark.parametrize("name", [*YARNS])
def test_every_published_yarn_closes_over_the_tile(name: str) -> None:
    model = YARNS[name]
    t = 2.0 * np.pi * np.arange(24) / 24
    points = np.column_stack([t / (2.0 * np.pi), 0.3 + 0.05 * np.sin(t), 0.02 * np.cos(t)])
    line = Curve.through(points, 0.0, np.array([1.0, 0.0, 0.0]))
    fibers = fibers_of(line, CrossSection(0.05, 0.03, False), model, np.random.default_rng(4))
    closed = [fiber for fiber in fibers if fiber.shift is not None]
    assert len(closed) == model.plies * model.fibers
    for fiber in closed[::7]:
        first, last = (fiber.at(np.array([s]))[0][0] for s in (0.0, float(len(fiber.control))))
        assert np.abs(last[:3] - first[:3] - fiber.shift).max() < 1e-9
        at = fiber.at(np.linspace(0.0, len(fiber.control), 200))[0]
        # Loops reach further out than the plies.
        assert np.abs(at[:, 2]).max() < 0.02 + 2.5 * 0.05
    along, around = roughness_of(name)  # type: ignore[arg-type]
    assert 0 < along < 1
    assert 0 < around < 1
