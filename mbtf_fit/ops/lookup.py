"""Textures, and where they are read: lookups in learned pyramids, the neighborhood of a query, parallax."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from mbtf_fit.ops.constants import GRAZING, MAX_CROSSINGS, OFFSET_SCALE
from mbtf_fit.ops.operation import Operation, TensorName, TextureName, Value


@dataclass(frozen=True)
class Lookup(Operation):
    """Bilinear lookup in periodic textures (NeuMIP, sections 4.1 and 4.2).

    At the fractional level l, ``(1 - frac(l)) T_⌊l⌋(u) + frac(l) T_⌊l⌋+1(u)``. Without a level the texture is
    that of the finest level alone. Row 0 is the side ``v → 1``, texel centers are at ``((i+½)/W,
    1-(j+½)/H)``.

    Attributes
    ----------
    u, level : position (2), fractional level (1) or None
    textures : tensors (rows, columns, channels) of the levels, coarsest first; of one without a level
    channels : features per texel
    oversampling : texels per texel of the level, along each axis
    finer : added to the level, which is then clamped: -1 reads the next coarser one
    """

    u: Value
    level: Value | None
    textures: TextureName
    channels: int
    oversampling: int = 1
    finer: float = 0.0

    def size(self, sizes: Sequence[int]) -> int:
        return self.channels


@dataclass(frozen=True)
class Neighborhood(Operation):
    """Positions of a grid around the query, a texel of the nearest level apart (Xue et al. 2024).

    ``(u + i / columns(s), v - j / rows(s))`` for i, j = -margin..margin and ``s = ⌊l + ½⌋``. What follows is
    computed at each of these positions, up to an :class:`~mbtf_fit.ops.network.Inception` network.

    Attributes
    ----------
    u, level : position (2), fractional level (1)
    margin : radius in texels
    """

    u: Value
    level: Value
    margin: int

    def size(self, sizes: Sequence[int]) -> int:
        return 2


@dataclass(frozen=True)
class Offset(Operation):
    """Neural offset of a position (NeuMIP, equations 7 and 8), a length in tile widths.

    Of a depth r (1), ``u' = u + scale r / max(ω_o,z, grazing) · ω_o,xy / (1, aspect)``; of a vector r (2),
    ``u' = u + scale r / (1, aspect)``.

    Attributes
    ----------
    u, r, omega_o : position (2), output of a network (1 or 2), view (3)
    """

    u: Value
    r: Value
    omega_o: Value
    scale: float = OFFSET_SCALE
    grazing: float = GRAZING

    def size(self, sizes: Sequence[int]) -> int:
        if sizes[1] > 2:
            raise ValueError(f"offset '{self.output}' reads {sizes[1]} numbers in place of 1 or 2")
        return 2


@dataclass(frozen=True)
class Trace(Operation):
    """Intersections of view rays with a periodic height field (relief mapping: Policarpo et al., I3D 2005).

    Rays start at the places ``x_j = u + 2^-l / 2 · (o_j,x ⊥a + o_j,y a) / (1, aspect)`` of the footprint,
    where a is the unit vector of the view's azimuth, (1, 0) of a vertical view, and ⊥a = (-a_y, a_x). z_j is
    the height of the first point, from above, of the line ``x_j + t ω_o`` on the surface; its uv is ``x_j +
    z_j / ω_o,z · ω_o,xy / (1, aspect)``. The output is the mean of z_j.

    The heights are those of vertices at texel centers, linear on the two triangles of each cell, which meet
    where ``x + y = 1`` (x along u, y along v, from 0 to 1). A ray that crosses the border of the grid more
    often than `crossings` times stops there.

    Attributes
    ----------
    hits, depths : names of the uv (2 per place) of the intersections, and of their heights z_j (1 per place)
    u, level, omega_o : position (2), fractional level (1), view (3)
    heights : tensor (rows, columns, 1) in tile widths, at most 0
    places : offsets o_j across and along the view's azimuth, in σ
    """

    hits: Annotated[str, "further output"]
    depths: Annotated[str, "further output"]
    u: Value
    level: Value
    omega_o: Value
    heights: TensorName
    places: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    crossings: int = MAX_CROSSINGS

    def size(self, sizes: Sequence[int]) -> int:
        return 1

    def results(self, sizes: Sequence[int]) -> dict[str, int]:
        if not self.places:
            raise ValueError(f"trace '{self.output}' has no places")
        return {self.output: 1, self.hits: 2 * len(self.places), self.depths: len(self.places)}


@dataclass(frozen=True)
class SurfaceMaps(Operation):
    """All numbers of the maps of :class:`~mbtf_fit.ops.shade.Shade`, at the level ``l + finer``.

    Attributes
    ----------
    u, level : position (2), fractional level (1)
    maps : textures by level
    channels : numbers of the maps: 8, 10 of glossy surfaces, 12 of coated ones
    finer : levels
    """

    u: Value
    level: Value
    maps: TextureName
    channels: int
    finer: float = 0.0

    def size(self, sizes: Sequence[int]) -> int:
        return self.channels


@dataclass(frozen=True)
class Displace(Operation):
    """Displacement of a position by a height: ``u' = u + w_l z / ω_o,z · ω_o,xy / (1, aspect)``.

    w_l is a learned weight of each level, linear between levels.

    Attributes
    ----------
    u, z, level, omega_o : position (2), height (1), fractional level (1), view (3)
    weights : tensor (levels,)
    learned : in training, the texture of learned heights that the gradient of z flows to
        (:mod:`mbtf_fit.models.learned_relief`); never stored
    """

    u: Value
    z: Value
    level: Value
    omega_o: Value
    weights: TensorName
    learned: TextureName | None = None

    def size(self, sizes: Sequence[int]) -> int:
        return 2

    def stored(self) -> Displace:
        return replace(self, learned=None)
