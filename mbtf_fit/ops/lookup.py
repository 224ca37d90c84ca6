"""Textures: lookups in learned pyramids, and the neighborhood of a query."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mbtf_fit.ops.operation import Operation, TextureName, Value


@dataclass(frozen=True)
class Lookup(Operation):
    """Bilinear lookup in periodic textures (NeuMIP, sections 4.1 and 4.2).

    At the fractional level l, ``(1 - frac(l)) T_⌊l⌋(u) + frac(l) T_⌊l⌋+1(u)``; or both terms side by side,
    that of the even level first (Quartesan et al. 2022). Without a level the texture is that of the finest
    level alone. Row 0 is the side ``v → 1``, texel centers are at ``((i+½)/W, 1-(j+½)/H)``.

    Attributes
    ----------
    u, level : position (2), fractional level (1) or None
    textures : tensors (rows, columns, channels) of the levels, coarsest first; of one without a level
    channels : features per texel
    blending : ``blend``, or ``concatenate`` for both terms
    oversampling : texels per texel of the level, along each axis
    """

    u: Value
    level: Value | None
    textures: TextureName
    channels: int
    blending: Literal["blend", "concatenate"] = "blend"
    oversampling: int = 1

    def size(self, sizes: Sequence[int]) -> int:
        return self.channels * (2 if self.blending == "concatenate" else 1)


@dataclass(frozen=True)
class Neighborhood(Operation):
    """Positions of a grid around the query, a texel of the nearest level apart (Xue et al. 2024, on the
    material).

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
