"""Yarns → plies → fibers: the procedural model of Zhao, Luan and Bala 2016, "Fitting procedural yarn models
for realistic cloth rendering" (ACM TOG 35(4)), sections 3.2 and 5.1.

Plies are twisted around the yarn's center line, at the distance ``R_ply``. Their cross-sections are ellipses
with the short axis towards the center. Fibers are twisted around the center of their ply. Their distances R
from it, in [0, 1], have the density ``p(R) = (1 - 2ε) ((e - e^R)/(e - 1))^β + ε`` over the disk (equation 1).
A fiber migrates: while it turns by θ, its distance is
``R_min R + (1 - R_min) R/2 (cos(s θ + φ) + 1)`` (equation 3). Flyaways are loops, one swing of a fiber that
is pulled out, and hairs, arcs that leave the ply (equation 11).

Everything closes over the tile: the turns of plies, fibers and swings per period are rounded to whole
numbers.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mbtf_gen.tile.fibers.curves import F64, LEAST_POINTS, Curve, closed_frames, level_frames

# Points of a fiber per turn around its ply, and per segment of the center line.
_PER_TURN, _PER_SEGMENT = 12, 2
# Points of a hair.
_HAIR_POINTS = 8

Spread = tuple[float, float]


@dataclass(frozen=True)
class YarnModel:
    """Statistics of a yarn. Lengths are in centimeters.

    Attributes
    ----------
    plies, fibers : plies of the yarn, fibers of a ply
    fiber_radius : radius of a fiber
    beta, epsilon : distribution of the fibers over a ply's cross-section
    pitch, ply_pitch : length of one turn of fibers around their ply, and of plies around the yarn; negative:
        clockwise
    migration, swing : R_min and s of the migration
    long_axis, short_axis : half axes of a ply's cross-section
    ply_distance : distance of a ply's center from that of the yarn
    loops, hairs : flyaways per centimeter of a ply
    loop_reach, hair_start, hair_rise, hair_length, hair_turn : mean and standard deviation of the distance of
        a loop from the ply's center, of that of a hair's start, of how much further its end is, of its length
        along the ply, and of the angle in radians around it
    """

    plies: int
    fibers: int
    fiber_radius: float
    beta: float
    epsilon: float
    pitch: float
    ply_pitch: float
    migration: float
    swing: float
    long_axis: float
    short_axis: float
    ply_distance: float
    loops: float
    hairs: float
    loop_reach: Spread
    hair_start: Spread
    hair_rise: Spread
    hair_length: Spread
    hair_turn: Spread

    @property
    def radius(self) -> float:
        """Half of the yarn's thickness, without flyaways."""
        return self.ply_distance + self.short_axis if self.plies > 1 else self.long_axis


@dataclass(frozen=True)
class CrossSection:
    """Half axes of a yarn in tile widths: along the cloth and perpendicular to it.

    A yarn that is `flat` keeps its axes parallel to the reference plane; its center line must be nowhere
    vertical. Otherwise the axes follow the center line without turning.
    """

    width: float
    height: float
    flat: bool


def fibers_of(line: Curve, section: CrossSection, model: YarnModel, rng: np.random.Generator) -> list[Curve]:
    """Fibers of a yarn.

    Parameters
    ----------
    line : closed center line; its radii are not used
    section : size of the yarn, which also scales its pitches and its fibers
    model : statistics
    rng : random numbers

    Returns
    -------
    list of Curve
        Of each ply, its fibers and then its hairs.
    """
    assert line.shift is not None
    length, scale, turns, ply_turns = _turns(line, section, model)
    n = _points(line, turns, ply_turns)
    s = np.arange(n) / n
    frame = _Frame(line, s, section, model)
    radius = model.fiber_radius * scale
    out = []
    for ply in range(model.plies):
        around = 2.0 * np.pi * (ply_turns * s + ply / model.plies)
        distance, phase = _disk(rng, model)
        start = 2.0 * np.pi * rng.random(model.fibers)
        pulled = _pulled(rng, model, length / scale)
        swings = max(1, round(model.swing * abs(turns)))
        for k in range(model.fibers):
            angle = 2.0 * np.pi * turns * s + phase[k]
            swing = 2.0 * np.pi * swings * s + start[k]
            reach = 0.5 * (1.0 + model.migration + (1.0 - model.migration) * np.cos(swing)) * distance[k]
            if k in pulled:
                reach = reach * _loop(swing, pulled[k] / distance[k])
            points = frame.points(around, reach * np.cos(angle), reach * np.sin(angle))
            out.append(Curve.through(points, radius, line.shift))
        out += _hairs(rng, model, frame, (ply_turns, ply / model.plies), length / scale, radius)
    return out


def count_segments(line: Curve, section: CrossSection, model: YarnModel) -> float:
    """Number of spline segments of :func:`fibers_of`."""
    length, scale, turns, ply_turns = _turns(line, section, model)
    hairs = model.hairs * length / scale * (_HAIR_POINTS - 3)
    return model.plies * (model.fibers * _points(line, turns, ply_turns) + hairs)


def _turns(line: Curve, section: CrossSection, model: YarnModel) -> tuple[float, float, int, int]:
    """(length of a center line, tile widths per centimeter, turns of fibers, turns of plies)."""
    segments = len(line.control)
    fine = np.arange(16 * segments) / 16.0
    length = float(np.linalg.norm(line.at(fine)[1][:, :3], axis=1).mean() * segments)
    scale = 0.5 * (section.width + section.height) / model.radius
    ply_turns = _whole(length / (scale * model.ply_pitch)) if model.plies > 1 else 0
    return length, scale, _whole(length / (scale * model.pitch)), ply_turns


def _points(line: Curve, turns: int, ply_turns: int) -> int:
    """Points of a fiber."""
    return max(
        _PER_SEGMENT * len(line.control), _PER_TURN * max(abs(turns + ply_turns), abs(turns)), LEAST_POINTS
    )


def _whole(turns: float) -> int:
    """Nearest whole number of turns, at least one, with its sign."""
    return int(np.sign(turns)) * max(1, round(abs(turns)))


class _Frame:
    """Positions around a center line at parameters s in [0, 1)."""

    def __init__(self, line: Curve, s: F64, section: CrossSection, model: YarnModel) -> None:
        at, slope = line.at(s * len(line.control))
        tangent = slope[:, :3] / np.linalg.norm(slope[:, :3], axis=1)[:, None]
        frames = level_frames if section.flat else closed_frames
        self.center, (self.side, self.up) = at[:, :3], frames(tangent)
        self.s, self.line, self.shift, self.model = s, line, line.shift, model
        self.scale = np.array([section.width, section.height]) / model.radius

    def points(self, around: F64, radial: F64, tangential: F64) -> F64:
        """Points (n, 3) at coordinates in a ply's cross-section, in half axes; the ply's center lies at the
        angle `around` the yarn."""
        model = self.model
        c, s = np.cos(around), np.sin(around)
        out = (model.ply_distance if model.plies > 1 else 0.0) + model.short_axis * radial
        across = model.long_axis * tangential
        x, y = (out * c - across * s) * self.scale[0], (out * s + across * c) * self.scale[1]
        return np.asarray(self.center + x[:, None] * self.side + y[:, None] * self.up)

    def between(self, s: F64) -> _Frame:
        """The frame at other parameters, which may go on beyond the period."""
        other = copy(self)
        turns = np.floor(s)
        at = (s - turns) * len(self.s)
        low = at.astype(int)
        share = (at - low)[:, None]

        def mixed(values: F64) -> F64:
            return np.asarray((1.0 - share) * values[low] + share * values[(low + 1) % len(values)])

        other.s = s
        other.center = (
            self.line.at((s - turns) * len(self.line.control))[0][:, :3] + turns[:, None] * self.shift
        )
        other.side, other.up = mixed(self.side), mixed(self.up)
        return other


def _disk(rng: np.random.Generator, model: YarnModel) -> tuple[F64, F64]:
    """(distances in [0, 1], angles) of a ply's fibers, by rejection sampling (algorithm 2)."""
    found = np.zeros((0, 2))
    while len(found) < model.fibers:
        xy = 2.0 * rng.random((4 * model.fibers, 2)) - 1.0
        distance = np.hypot(*xy.T)
        base = np.maximum((np.e - np.exp(distance)) / (np.e - 1.0), 0.0)
        density = (1.0 - 2.0 * model.epsilon) * base**model.beta + model.epsilon
        found = np.concatenate([found, xy[(distance < 1.0) & (rng.random(len(xy)) < density)]])
    x, y = found[: model.fibers].T
    return np.hypot(x, y), np.arctan2(y, x)


def _pulled(rng: np.random.Generator, model: YarnModel, length: float) -> dict[int, float]:
    """Fibers of a ply that have a loop, with its reach in half axes."""
    count = min(int(model.loops * length), model.fibers)
    chosen = rng.choice(model.fibers, count, replace=False)
    reach = rng.normal(*model.loop_reach, count) / model.long_axis
    return {int(k): max(float(r), 1.0) for k, r in zip(chosen, reach, strict=True)}


def _loop(swing: F64, factor: float) -> F64:
    """Factors on the distances of a fiber: its first whole swing in the period is pulled out."""
    through = np.clip((swing - swing[0]) / (2.0 * np.pi), 0.0, 1.0)
    return np.asarray(1.0 + (max(factor, 1.0) - 1.0) * 0.5 * (1.0 - np.cos(2.0 * np.pi * through)))


def _hairs(
    rng: np.random.Generator,
    model: YarnModel,
    frame: _Frame,
    ply: tuple[int, float],
    length: float,
    radius: float,
) -> list[Curve]:
    """Hairs of a ply, given by its turns and its phase in turns, of a length in centimeters."""
    out = []
    t = np.linspace(0.0, 1.0, _HAIR_POINTS)
    for _ in range(int(model.hairs * length)):
        begin, angle = rng.random(), 2.0 * np.pi * rng.random()
        spreads = (model.hair_start, model.hair_rise, model.hair_length, model.hair_turn)
        first, rise, along, turn = (rng.normal(*spread) for spread in spreads)
        s = begin + t * along / length
        reach = np.abs(first + rise * t) / model.long_axis
        turned = angle + turn * t
        around = 2.0 * np.pi * (ply[0] * s + ply[1])
        points = frame.between(s).points(around, reach * np.cos(turned), reach * np.sin(turned))
        out.append(Curve(np.column_stack([points, np.full(len(points), radius)])))
    return out


YarnName = Literal[
    "cotton1", "cotton2", "rayon1", "rayon2", "rayon3", "rayon4", "silk1", "silk2", "polyester1"
]

_COTTON, _RAYON, _SILK, _POLYESTER = 8.5e-4, 7.5e-4, 6e-4, 9e-4

# Longitudinal and azimuthal roughness of each material.
ROUGHNESS: dict[str, tuple[float, float]] = {
    "cotton": (0.72, 0.60),
    "rayon": (0.35, 0.48),
    "silk": (0.35, 0.41),
    "polyester": (0.35, 0.41),
}

YARNS: dict[YarnName, YarnModel] = {
    "cotton1": YarnModel(
        plies=4, fibers=75, fiber_radius=_COTTON, beta=0.148, epsilon=0.0, pitch=-0.369, ply_pitch=0.453,
        migration=0.80, swing=1.1, long_axis=0.026, short_axis=0.020, ply_distance=0.038,
        loops=22.17, hairs=33.77, loop_reach=(0.024, 0.005), hair_start=(0.020, 0.006),
        hair_rise=(0.016, 0.009), hair_length=(-0.003, 0.057), hair_turn=(0.377, 0.326),
    ),
    "cotton2": YarnModel(
        plies=4, fibers=37, fiber_radius=_COTTON, beta=0.430, epsilon=0.033, pitch=-0.436, ply_pitch=0.336,
        migration=0.95, swing=1.9, long_axis=0.025, short_axis=0.018, ply_distance=0.033,
        loops=13.34, hairs=19.50, loop_reach=(0.026, 0.007), hair_start=(0.021, 0.005),
        hair_rise=(0.014, 0.006), hair_length=(0.019, 0.048), hair_turn=(0.480, 0.404),
    ),
    "rayon1": YarnModel(
        plies=2, fibers=150, fiber_radius=_RAYON, beta=0.682, epsilon=0.139, pitch=0.710, ply_pitch=-0.639,
        migration=0.85, swing=1.9, long_axis=0.053, short_axis=0.036, ply_distance=0.051,
        loops=62.40, hairs=52.52, loop_reach=(0.050, 0.009), hair_start=(0.041, 0.007),
        hair_rise=(0.020, 0.018), hair_length=(0.016, 0.059), hair_turn=(0.403, 0.437),
    ),
    "rayon2": YarnModel(
        plies=2, fibers=80, fiber_radius=_RAYON, beta=0.293, epsilon=0.052, pitch=-0.381, ply_pitch=0.372,
        migration=0.85, swing=1.6, long_axis=0.028, short_axis=0.021, ply_distance=0.029,
        loops=39.08, hairs=50.39, loop_reach=(0.026, 0.006), hair_start=(0.018, 0.005),
        hair_rise=(0.012, 0.007), hair_length=(0.001, 0.025), hair_turn=(0.439, 0.498),
    ),
    "rayon3": YarnModel(
        plies=2, fibers=143, fiber_radius=_RAYON, beta=0.640, epsilon=0.0, pitch=0.609, ply_pitch=-0.638,
        migration=0.95, swing=1.9, long_axis=0.044, short_axis=0.034, ply_distance=0.042,
        loops=44.51, hairs=53.72, loop_reach=(0.041, 0.015), hair_start=(0.030, 0.005),
        hair_rise=(0.028, 0.017), hair_length=(-0.014, 0.110), hair_turn=(0.821, 0.707),
    ),
    "rayon4": YarnModel(
        plies=2, fibers=122, fiber_radius=_RAYON, beta=0.671, epsilon=0.361, pitch=0.560, ply_pitch=-0.498,
        migration=0.70, swing=1.7, long_axis=0.048, short_axis=0.034, ply_distance=0.045,
        loops=59.40, hairs=65.23, loop_reach=(0.043, 0.008), hair_start=(0.038, 0.007),
        hair_rise=(0.021, 0.016), hair_length=(0.009, 0.048), hair_turn=(0.326, 0.287),
    ),
    "silk1": YarnModel(
        plies=4, fibers=33, fiber_radius=_SILK, beta=0.462, epsilon=0.0, pitch=-0.458, ply_pitch=0.526,
        migration=0.95, swing=1.8, long_axis=0.025, short_axis=0.022, ply_distance=0.038,
        loops=20.32, hairs=23.82, loop_reach=(0.024, 0.004), hair_start=(0.021, 0.004),
        hair_rise=(0.014, 0.011), hair_length=(0.010, 0.050), hair_turn=(0.407, 0.390),
    ),
    "silk2": YarnModel(
        plies=4, fibers=47, fiber_radius=_SILK, beta=0.554, epsilon=0.405, pitch=-0.556, ply_pitch=0.702,
        migration=0.70, swing=1.2, long_axis=0.031, short_axis=0.025, ply_distance=0.045,
        loops=18.89, hairs=23.09, loop_reach=(0.029, 0.004), hair_start=(0.024, 0.005),
        hair_rise=(0.010, 0.008), hair_length=(0.008, 0.038), hair_turn=(0.417, 0.446),
    ),
    "polyester1": YarnModel(
        plies=2, fibers=60, fiber_radius=_POLYESTER, beta=0.258, epsilon=0.202, pitch=-0.379, ply_pitch=0.370,
        migration=0.75, swing=1.5, long_axis=0.029, short_axis=0.021, ply_distance=0.029,
        loops=35.69, hairs=30.44, loop_reach=(0.027, 0.004), hair_start=(0.021, 0.005),
        hair_rise=(0.011, 0.009), hair_length=(-0.003, 0.036), hair_turn=(0.356, 0.400),
    ),
}  # fmt: skip


def roughness_of(name: YarnName) -> tuple[float, float]:
    """Longitudinal and azimuthal roughness of a yarn's fibers."""
    return ROUGHNESS[name.rstrip("0123456789")]
