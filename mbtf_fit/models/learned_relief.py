r"""NeuMIP with learned heights, for data without a geometry: ``neumip+``.

The neural offset of NeuMIP (:mod:`mbtf_fit.models.neumip`) guesses the displacement from one texel and the
view. Here the displacement is that of a height field, which is learned in its place: one number x per texel
of the finest level, blurred like the other textures, with the height ``z = min(0, 0.25 x - 0.04)`` in tile
widths. The model reads textures and hints like :mod:`relief <mbtf_fit.models.relief>`, of the surface that it
learned.

A view ray meets the surface where ``z = h(u + z/ω_o,z · ω_o,xy)``. By the implicit function theorem, raising
the height there by dh raises the intersection by

    dz = dh / (1 - ∇h · ω_o,xy / ω_o,z).

Texels of the height get that gradient through the displacement of the lookup. The denominator and the view's
cosine are at least 0.3 in it, so that steep slopes and grazing views do not decide alone. The hints are
constants of a step. During training rays are traced to the current heights every few steps; normals and
horizons, which take longer to filter, follow less often.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mbtf_core.data.geometry import Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_fit.config import NetworkSection
from mbtf_fit.models.constants import FIRST_DEPTH, HEIGHT_SCALE, LEAST_FACING
from mbtf_fit.models.lookup import lookup
from mbtf_fit.models.relief import Relief
from mbtf_fit.models.textures import FeatureTextures
from mbtf_fit.surface.known import KnownSurface

# Steps of training after which rays are traced to the current heights.
TRACED = 10
# Steps after which normals and horizons are filtered again, for textures of so many texels and fewer; for
# larger ones in proportion, so that the filter takes a fixed share of the time. In short fits they are
# filtered so many times at least, in equal parts of the budget.
FILTERED, FILTERED_TEXELS, FILTERED_LEAST = 40, 1 << 14, 8


class LearnedRelief(Relief):
    """A model that learns the heights of the surface.

    Attributes
    ----------
    heights : FeatureTextures
        The learned numbers x, one channel at the finest level. A material stores the surface alone.
    light_width : float
        RMS angle per axis of the data's light kernel, in degrees.
    """

    name = "neumip+"

    def __init__(self, lattice: Lattice, network: NetworkSection) -> None:
        super().__init__(lattice, network)
        self.heights = FeatureTextures(lattice, [lattice.finest], 1, moves_lookups=True)
        self.light_width = 0.0
        # Part of the budget in which normals and horizons were filtered.
        self._part = 0
        self._filtered = torch.zeros(lattice.shape())

    def initialize(self, generator: torch.Generator, unit: float) -> None:
        super().initialize(generator, unit)
        nn.init.zeros_(self.heights.texels)
        self.follow(0, 0.0)

    def follow(self, step: int, sigma: float, fraction: float = 0.0) -> None:
        """Let rays and hints see the learned heights, blurred by `sigma` texels, where it is their turn
        before a step of training, after a fraction of its budget."""
        interval = FILTERED * max(1, self.heights.packing.texels // FILTERED_TEXELS)
        part = int(FILTERED_LEAST * fraction)
        filtered = step % interval == 0 or part != self._part
        self._part = part
        with torch.no_grad():
            # Above the reference plane a texel would have a gradient without an effect.
            self.heights.texels.clamp_(max=FIRST_DEPTH / HEIGHT_SCALE)
            if not (filtered or step % TRACED == 0):
                return
            x = self.heights.blurred(sigma).view(self.lattice.shape())
            self._see((HEIGHT_SCALE * x - FIRST_DEPTH).clamp_max(0.0).cpu(), filtered=filtered)

    def _see(self, heights: Tensor, *, filtered: bool) -> None:
        if not filtered:
            self.know(self.known.with_heights(heights))
            return
        self._filtered = heights
        geometry = Geometry.of_heights(heights.numpy(), self.lattice.aspect)
        self.know(KnownSurface.of(geometry, self.lattice, self.light_width))

    def surface_state(self) -> dict[str, Tensor]:
        """Heights (H, W) that rays see, those that normals and horizons were filtered from, and in which part
        of the budget."""
        part = torch.tensor(self._part)
        return {"heights": self.known.heights, "filtered": self._filtered, "part": part}

    def restore_surface(self, state: Mapping[str, Tensor]) -> None:
        """Inverse of :meth:`surface_state`."""
        self._see(state["filtered"], filtered=True)
        self._see(state["heights"], filtered=False)
        self._part = int(state["part"])

    def start_from(self, heights: Tensor) -> None:
        """Start from heights (H, W) of another material."""
        with torch.no_grad():
            self.heights.texels.copy_(
                ((heights + FIRST_DEPTH) / HEIGHT_SCALE).reshape(self.heights.texels.shape)
            )
        self._see(heights, filtered=True)

    def displaced(self, u: Tensor, level: Tensor, height: Tensor, omega_o: Tensor) -> Tensor:
        moved = super().displaced(u, level, height, omega_o)
        if not torch.is_grad_enabled():
            return moved
        aspect = u.new_tensor([1.0, self.lattice.aspect])
        slope = omega_o[:, :2] / omega_o[:, 2:]
        hit = (u + height * slope / aspect).detach().requires_grad_()
        still = lookup(self.heights.table.detach(), self.heights.packing, hit)
        (gradient,) = torch.autograd.grad(still.sum(), hit)
        x = self.heights(hit.detach())
        facing = 1.0 - HEIGHT_SCALE * (gradient / aspect * slope).sum(1, keepdim=True)
        # Of value 0.
        rise = HEIGHT_SCALE * (x - x.detach()) / facing.clamp_min(LEAST_FACING)
        along = omega_o[:, :2] / omega_o[:, 2:].clamp_min(LEAST_FACING)
        weight = self.depth_weight(level)[:, None].detach()
        return moved + weight * rise * along / aspect

    def stored_textures(self) -> dict[str, FeatureTextures]:
        return {name: t for name, t in super().stored_textures().items() if t is not self.heights}
