"""The hierarchical neural material.

Xue, Zhao, Jensen, Montazeri: *A Hierarchical Architecture for Neural Materials*, Computer Graphics Forum
2024: NeuMIP's pyramid and offset, encoded positions and directions, a decoder of Inception modules that reads
neighboring queries, and the fourth root of the value as its output.

Deviations from the paper:

- **The neighbors are positions of the material, not pixels of an image.** The decoder reads a grid of 9 × 9
  samples around the query, one texel of the level nearest to its footprint apart. The value is therefore a
  function of the query alone, as renderers require; in the paper it depends on the neighboring pixels.
- The grid wraps around the tile; the published code pads with zeros.
- Training reads the same grids from images, which have one query at a random position in each texel. For
  queries at the texels' centers, training and evaluation are identical.
- Positions are encoded as ``p = 2u - 1`` with π, so that the encoding is continuous at the tile's seam, and
  before the offset; raw coordinates are omitted.
- Encodings are filtered by the footprint and attenuated, and directions are encoded without π: with the
  paper's choices short fits do not converge (they remain available in ``network.encoding``).
- The output x is the value ``unit · x|x|³``, an odd function.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from mbtf_core.data.schema import Layout
from mbtf_fit.models.inception import InceptionDecoder
from mbtf_fit.models.interface import NeuralMaterial


class Hierarchical(NeuralMaterial):
    """Textures, offset, and a decoder that reads a neighborhood on the material.

    With ``network.decoder: mlp`` the neighborhood is the query alone.
    """

    name = "hierarchical"
    layout: ClassVar[Layout] = "image"

    def neighborhood(self, u: Tensor, sigma: Tensor) -> Tensor:
        """Positions (n, 2·margin+1, 2·margin+1, 2) around `u` (n, 2), a texel of the nearest level apart:
        image rows downwards, columns to the right."""
        shapes = u.new_tensor([self.lattice.shape(s) for s in range(self.lattice.finest + 1)])
        rows, columns = shapes[(self.level(sigma) + 0.5).floor().long()].unbind(1)
        steps = torch.arange(-self.margin, self.margin + 1, dtype=u.dtype, device=u.device)
        along_u = u[:, :1] + steps / columns[:, None]
        along_v = u[:, 1:] - steps / rows[:, None]
        size = len(steps)
        return torch.stack(
            [along_u[:, None].expand(-1, size, -1), along_v[:, :, None].expand(-1, -1, size)], -1
        )

    def read_features(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        """Features (items, rows, columns, f) at positions (items, rows, columns, 2) that share footprint
        (items,) and view (items, 3)."""
        items, rows, columns, _ = u.shape
        count = rows * columns
        features = self.features(
            u.reshape(-1, 2), sigma.repeat_interleave(count), omega_o.repeat_interleave(count, 0)
        )
        return features.view(items, rows, columns, -1)

    def decode(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Values (items, rows-2·margin, columns-2·margin, 3) of features (items, rows, columns, f) that share
        light and view (items, 3)."""
        directions = self.directions(omega_i, omega_o)
        if isinstance(self.decoder, InceptionDecoder):
            return self.to_value(self.decoder(features, directions))
        items, rows, columns, _ = features.shape
        repeated = directions[:, None, None].expand(items, rows, columns, -1)
        x: Tensor = self.decoder(torch.cat([features, repeated], -1).flatten(0, 2))
        return self.to_value(x).view(items, rows, columns, 3)

    def evaluate_patches(self, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        """Values (items, rows, columns, 3) at positions (items, rows+2·margin, columns+2·margin, 2) that
        share footprint (items,), light and view (items, 3)."""
        return self.decode(self.read_features(u, sigma, omega_o), omega_i, omega_o)

    def stage1(self, u: Tensor, sigma: Tensor, omega_o: Tensor) -> Tensor:
        return self.read_features(self.neighborhood(u, sigma), sigma, omega_o)

    def stage2(self, features: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
        return self.decode(features, omega_i, omega_o)[:, 0, 0]

    def formula(self) -> dict[str, str]:
        if self.margin == 0:
            return super().formula()
        size = 2 * self.margin + 1
        level = "level s = floor(clamp(-log2(2 sigma), 0, k) + 1/2), of rows(s) x columns(s) texels"
        return {
            "samples": f"{size} x {size} positions (u + i / columns(s), v - j / rows(s)), i and j = "
            f"-{self.margin}..{self.margin}, at {level}; each is u in what follows, up to features",
            **super().formula(),
            "x": "decoder(features at all samples, light, view) at the middle: 1x1 convolution 'first' over "
            "(features, light, view); Inception modules 0, 1, ...; 1x1 convolution 'last'; no padding. A "
            "module joins one(x), three(before3(x)), five(before5(x)) and pooled(3x3 maximum of x); an "
            "activation follows every convolution but the last",
        }
