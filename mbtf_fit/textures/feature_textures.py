"""Learned periodic textures: one level, or a pyramid of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from mbtf_core.data.lattice import Lattice
from mbtf_fit.textures.blur import blur_texture
from mbtf_fit.textures.lookup import Packing, lookup


class FeatureTextures(nn.Module):
    """Textures of some levels of a lattice, all of them independent parameters (NeuMIP, section 4.1).

    Parameters
    ----------
    lattice : texel grids of the tile
    levels : the lattice's levels to hold, coarsest first; `level` of :meth:`forward` counts from the first
    channels : features per texel
    moves_lookups : whether the features are inputs of the offset network

    Attributes
    ----------
    texels : (texels, channels) parameter, all levels one after the other
    """

    def __init__(
        self, lattice: Lattice, levels: Sequence[int], channels: int, *, moves_lookups: bool = False
    ) -> None:
        super().__init__()
        self.moves_lookups = moves_lookups
        self.packing = Packing.of(lattice, levels)
        self.texels = nn.Parameter(torch.zeros(self.packing.texels, channels))
        self._table: Tensor | None = None

    @property
    def table(self) -> Tensor:
        """What lookups read: the texels, or the last argument of :meth:`read`."""
        return self.texels if self._table is None else self._table

    def read(self, table: Tensor | None) -> None:
        """Let lookups read a table instead of the texels; None restores the texels."""
        # The texels themselves must not become a second parameter of the module.
        self._table = None if table is self.texels else table

    def blurred(self, sigma: float) -> Tensor:
        """The texels, blurred by a Gaussian of `sigma` texels of the finest level.

        Coarser levels get the same blur in tile widths: half as many texels each (as in the published
        code).
        """
        if sigma <= 0:
            return self.texels
        starts, shapes = self.packing.starts, self.packing.shapes
        finest = shapes[-1][1]
        parts = []
        for s, (rows, columns) in enumerate(shapes):
            texture = self.texels[starts[s] : starts[s + 1]]
            blurred = blur_texture(texture.view(rows, columns, -1), sigma * columns / finest)
            parts.append(blurred.reshape(texture.shape))
        return torch.cat(parts)

    def average_coarser(self, first: int) -> None:
        """Replace all levels coarser than `first` by averages of that level."""
        starts, shapes = self.packing.starts, self.packing.shapes
        if first <= 0:
            return
        with torch.no_grad():
            finer = self.texels[starts[first] : starts[first + 1]].t().view(1, -1, *shapes[first])
            averages = (nn.functional.adaptive_avg_pool2d(finer, shape)[0] for shape in shapes[:first])
            self.texels[: starts[first]] = torch.cat([a.flatten(1).t() for a in averages])

    def export(self) -> dict[str, Tensor]:
        """Current table by level, ``0`` the coarsest: (rows, columns, channels) each."""
        starts, table = self.packing.starts, self.table.detach()
        return {
            str(s): table[starts[s] : starts[s + 1]].view(rows, columns, -1).clone()
            for s, (rows, columns) in enumerate(self.packing.shapes)
        }

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Load tensors of :meth:`export`, to be read without blur; other entries are ignored."""
        self._table = None
        with torch.no_grad():
            parts = [tensors[str(s)].flatten(0, 1) for s in range(len(self.packing.shapes))]
            self.texels.copy_(torch.cat(parts))

    def forward(self, u: Tensor, level: Tensor | None = None) -> Tensor:
        """Features (n, channels) at uv positions `u` (n, 2); see :func:`~mbtf_fit.textures.lookup.lookup`."""
        return lookup(self.table, self.packing, u, level)
