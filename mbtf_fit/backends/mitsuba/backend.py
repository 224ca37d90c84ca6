"""What implementations of operations in Dr.Jit kernels have in common.

An implementation is called once per material: it reads and checks the operation's tensors, and returns a
function, its *step*. A step is called whenever a kernel is recorded, with the values that the operation's
fields name, and returns its results. A value is a list of numbers, one Dr.Jit array each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_core.data.lattice import Lattice
from mbtf_core.errors import InputError
from mbtf_fit.backends.mitsuba.stored_material import F32, StoredMaterial
from mbtf_fit.backends.mitsuba.textures import Textures
from mbtf_fit.material.format import WEIGHTS_NAME
from mbtf_fit.ops import Backend, Operation
from mbtf_fit.ops.operation import input_sizes
from mbtf_gen.engine.types import Float
from mbtf_gen.tile.tracers.heightfield_tracer import HeightfieldGeometry

Arithmetic = Literal["unrolled", "cooperative", "half"]
Numbers = list[Float]
# One result, or a tuple of several.
Step = Callable[..., Any]

MITSUBA: Backend[Callable[[Any, Loader], Step]] = Backend("the Mitsuba plugin")


@dataclass(frozen=True)
class Loader:
    """The material that implementations read.

    Attributes
    ----------
    stored : the material
    arithmetic : of networks
    sizes : of all values
    textures, heightfields : those that have been read, by name
    """

    stored: StoredMaterial
    arithmetic: Arithmetic
    sizes: Mapping[str, int]
    textures: dict[str, Textures] = field(default_factory=dict)
    heightfields: dict[str, HeightfieldGeometry] = field(default_factory=dict)

    @property
    def lattice(self) -> Lattice:
        """Texel grids of the tile."""
        return self.stored.lattice

    def heightfield(self, name: str) -> HeightfieldGeometry:
        """Heights that rays are traced to.

        Raises
        ------
        InputError : the tensor is empty, or has positive heights
        """
        known = self.heightfields
        if name not in known:
            heights = self.stored.take(name, (None, None, 1))[..., 0]
            if heights.size == 0 or heights.max() > 0:
                fault = "is empty" if heights.size == 0 else "has heights above the reference plane"
                raise InputError(f"its tensor '{name}' {fault}", where=self.stored.folder / WEIGHTS_NAME)
            aspect, z = self.lattice.aspect, heights.astype(np.float64)
            known[name] = HeightfieldGeometry.of(z, aspect, 1.0, two_sided=False)
        return known[name]

    def inputs(self, op: Operation) -> list[int]:
        """Sizes of an operation's inputs."""
        return input_sizes(op, self.sizes)

    def levels(self, name: str, grids: list[tuple[int, int]], channels: int) -> list[F32]:
        """Levels of a texture, of these grids."""
        return [self.stored.take(f"{name}.{s}", (*grid, channels)) for s, grid in enumerate(grids)]

    def texture(self, name: str, grids: list[tuple[int, int]], channels: int) -> Textures:
        """A texture, which operations may share and users may change."""
        if name not in self.textures:
            self.textures[name] = Textures(self.levels(name, grids, channels))
        return self.textures[name]

    def grids(self, finer: int = 0) -> list[tuple[int, int]]:
        """Rows and columns of the levels, and of so many finer ones."""
        lattice = Lattice(self.lattice.finest + finer, self.lattice.aspect)
        return [lattice.shape(s) for s in range(lattice.finest + 1)]

    def maps(self, name: str, channels: int) -> Textures:
        """Maps of a surface, which may have a level more."""
        return self.texture(
            name, self.grids(f"{name}.{self.lattice.finest + 1}" in self.stored.tensors), channels
        )

    def scalar(self, name: str) -> float:
        """A tensor ()."""
        return float(self.stored.take(name, ()))


def opaque(value: float) -> Float:
    """A number that kernels read, so that they do not depend on it."""
    return dr.opaque(mi.Float, value)
