"""Inputs of networks: directions in frames, frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mbtf_fit.ops.operation import Operation, Value


@dataclass(frozen=True)
class HalfVector(Operation):
    """``(ω_i + ω_o) / ‖ω_i + ω_o‖`` (3)."""

    omega_i: Value
    omega_o: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 3


@dataclass(frozen=True)
class Rotate(Operation):
    """A direction, rotated by the shortest rotation that takes an axis to z (3).

    ``(ω_xy - a_xy (ω_z + t / (1 + a_z)), a_z ω_z + t)``, ``t = a_xy · ω_xy``. About the half vector, the
    light becomes the difference vector (Rusinkiewicz, EGSR 1998), in a frame that is continuous everywhere.

    Attributes
    ----------
    axis : unit vector with z > 0 (3); of two numbers, z is ``√max(0, 1 - x² - y²)``
    omega : direction (3)
    """

    axis: Value
    omega: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 3


@dataclass(frozen=True)
class Stereographic(Operation):
    """A direction, projected from the nadir: ``ω_xy / (1 + ω_z)`` (2)."""

    omega: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 2


@dataclass(frozen=True)
class Position(Operation):
    """``p = 2 (u mod 1) - 1`` (2): with frequencies of π, periodic over the tile."""

    u: Value

    def size(self, sizes: Sequence[int]) -> int:
        return 2


@dataclass(frozen=True)
class Frequencies(Operation):
    """Sines of doubling frequencies, then cosines (NeRF: Mildenhall et al., ECCV 2020; for materials: Xue et
    al. 2024).

    ``sin(f_k x)`` with ``f_k = 2^k`` or ``2^k π``, k = 0..bands-1 of the first coordinate, then of the next;
    then the cosines likewise. With a level, each is averaged over the footprint of a :class:`Position`, that
    is multiplied by ``exp(-(f_k s)²/2)``, ``s = 2^-l / (1, aspect)`` (mip-NeRF: Barron et al., ICCV 2021).

    Attributes
    ----------
    x, level : coordinates, fractional level (1) or None
    bands : frequencies of each coordinate
    pi : frequencies of π
    raw : put the coordinates themselves first
    attenuated : divide band k by 2^k
    """

    x: Value
    level: Value | None
    bands: int
    pi: bool = True
    raw: bool = False
    attenuated: bool = False

    def size(self, sizes: Sequence[int]) -> int:
        return sizes[0] * (2 * self.bands + self.raw)
