"""Fibers in relief, and the plies and yarns that they lie on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .noise import SIZE, Field, Indices, noise, smooth, uniform


@dataclass(frozen=True)
class Surface:
    """The topmost of many tubes, seen from above.

    Attributes
    ----------
    z : height in tile widths
    tube : number of the tube, -1 for the ground below all of them
    angle : position around the tube from its top, in (-π/2, π/2)
    """

    z: Field
    tube: Indices
    angle: Field

    @classmethod
    def ground(cls, z: Field) -> Surface:
        """Nothing but ground."""
        return cls(z, np.full(z.shape, -1), np.zeros_like(z))

    def with_tube(self, tube: int, offset: Field, radius: Field, z: Field) -> Surface:
        """One more tube.

        Parameters
        ----------
        offset : across the tube, from its axis
        radius : half its width in the direction of `offset`
        z : height of the surface above `offset`, where it is within the radius
        """
        x = offset / radius
        upper = (np.abs(x) < 1.0) & (z > self.z)
        return Surface(
            np.where(upper, z, self.z),
            np.where(upper, tube, self.tube),
            np.where(upper, np.arcsin(np.clip(x, -1.0, 1.0)), self.angle),
        )


def strands(across: Field, along: Field, count: int, waves: int, seed: int) -> tuple[Field, Field]:
    """(relief, tone) of parallel fibers that lie over and under one another.

    Parameters
    ----------
    across, along : coordinates of period 1; fibers run along `along` and lean as `across` leans
    count : fibers across the period
    waves : lattice cells of their waviness along the period

    Relief is about 0 to 1; tone, one number in [0, 1) for each fiber and layer.
    """
    relief, tone = np.full(across.shape, -1.0), np.zeros_like(across)
    for layer in range(3):
        key = seed + 17 * layer
        wobble = noise(across, along, (max(count // 4, 2), waves), key)
        x = (across + (1.1 * wobble + layer / 3.0) / count) * count
        number = np.floor(x) % count
        line = (number + 0.5) / count
        # A fiber comes up and dives under; each does so at its own places.
        level = noise(line, along, (count, 2 * waves), key + 1)
        z = 0.9 * level + 0.75 * (1.0 - (2.0 * (x - np.floor(x)) - 1.0) ** 2)
        upper = z > relief
        relief = np.where(upper, z, relief)
        tone = np.where(upper, uniform(key + 2, number), tone)
    return np.asarray(np.clip(relief + 0.05, 0.0, 1.2)), tone


def stray_fibers(u: Field, v: Field, count: int, seed: int) -> Field:
    """Coverage (0 to 1) by single fibers that have come loose and curl over the surface, in any direction."""
    cover = np.zeros_like(u)
    for fiber in range(count):
        x, y, turn, size, curl = (float(uniform(seed, fiber, k)[0]) for k in range(5))
        cos, sin = np.cos(2.0 * np.pi * turn), np.sin(2.0 * np.pi * turn)
        du, dv = (u - x + 0.5) % 1.0 - 0.5, (v - y + 0.5) % 1.0 - 0.5
        length = 0.06 + 0.12 * size
        here = np.hypot(du, dv) < 1.3 * length
        du, dv = du[here], dv[here]
        along, apart = du * cos + dv * sin, dv * cos - du * sin
        bend = 4.0 * (curl - 0.5) * along**2 + 0.012 * np.sin(along / length * 5.0 + 6.0 * curl)
        line = smooth(1.3 / SIZE, 0.3 / SIZE, np.abs(apart - bend))
        cover[here] = np.maximum(cover[here], line * smooth(length, 0.85 * length, np.abs(along)))
    return cover
