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

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from mbtf_fit.models.model import PYRAMID, Preparation
from mbtf_fit.models.relief import Relief
from mbtf_fit.ops.constants import FIRST_DEPTH, HEIGHT_SCALE

if TYPE_CHECKING:
    from torch import Tensor

    from mbtf_fit.pytorch.material import NeuralMaterial

# Steps of training after which rays are traced to the current heights.
TRACED = 10
# Steps after which normals and horizons are filtered again, for textures of so many texels and fewer; for
# larger ones in proportion, so that the filter takes a fixed share of the time. In short fits they are
# filtered so many times at least, in equal parts of the budget.
FILTERED, FILTERED_TEXELS, FILTERED_LEAST = 160, 1 << 14, 4


class LearnedRelief(Relief):
    """A model that learns the heights of the surface; a material stores the surface alone.

    Attributes
    ----------
    light_width : RMS angle per axis of the data's light kernel, in degrees
    """

    name = "neumip+"
    description = "learns the heights that it traces"
    defaults: ClassVar[Mapping[str, Any]] = {
        "network": {
            "offset": "none",
            "channels": 12,
            "encoding": {"direction_xyz": True, "half_vector": True},
            # Without the reflectance of the surface there is no single scattering to scale.
            "relief": {"gate": False},
        },
        "training": {
            "residual_levels": True,
            "texture_weight_decay": 1.0,
            "blur": {"min_sigma": 0.8, "offset_sigma": 2.0},
            # The relative loss alone leaves the grazing highlights of fibers at half their value.
            "losses": [
                {"kind": "relative"},
                {"kind": "chroma", "weight": 3.0},
                {"kind": "squared", "weight": 0.1},
            ],
        },
    }
    reads_geometry: ClassVar[Sequence[str]] = ()
    takes = (*PYRAMID, *(f"network.relief.{name}" for name in ("hints", "frame", "gate")))
    learned = "heights"

    def __init__(self, material: NeuralMaterial) -> None:
        super().__init__(material)
        self.light_width = 0.0
        # Part of the budget in which normals and horizons were filtered, and the heights that they are of.
        self._part = 0
        self._filtered: Tensor | None = None

    def prepare(self, given: Preparation) -> Any:
        self.light_width = given.data.light_width or 0.0
        self.follow(0, 0.0)
        return given.queries

    def precompute(self, queries: Any, memory: float) -> Any:
        return queries

    def before_step(self, step: int, fraction: float, sigmas: Mapping[str, float], batch: Any) -> Any:
        self.follow(step, sigmas["heights"], fraction)
        return super().before_step(step, fraction, sigmas, batch)

    def follow(self, step: int, sigma: float, fraction: float = 0.0) -> None:
        """Let rays and hints see the learned heights, blurred by `sigma` texels, where it is their turn
        before a step of training, after a fraction of its budget."""
        import torch

        heights = self.material.texture("heights")
        interval = FILTERED * max(1, heights.packing.texels // FILTERED_TEXELS)
        part = int(FILTERED_LEAST * fraction)
        filtered = step % interval == 0 or part != self._part
        self._part = part
        with torch.no_grad():
            # Above the reference plane a texel would have a gradient without an effect.
            heights.texels.clamp_(max=FIRST_DEPTH / HEIGHT_SCALE)
            if not (filtered or step % TRACED == 0):
                return
            x = heights.blurred(sigma).view(self.material.lattice.shape())
            self._see((HEIGHT_SCALE * x - FIRST_DEPTH).clamp_max(0.0).cpu(), filtered=filtered)

    def _see(self, heights: Tensor, *, filtered: bool) -> None:
        from mbtf_core.data.geometry import Geometry
        from mbtf_fit.surface.known import KnownSurface

        material = self.material
        if not filtered:
            material.know(material.known.with_heights(heights))
            return
        self._filtered = heights
        geometry = Geometry.of_heights(heights.numpy(), material.lattice.aspect)
        material.know(KnownSurface.of(geometry, material.lattice, self.light_width))

    def state(self) -> dict[str, Tensor]:
        """Heights (H, W) that rays see, those that normals and horizons were filtered from, and in which part
        of the budget."""
        import torch

        assert self._filtered is not None
        part = torch.tensor(self._part)
        return {"heights": self.material.known.heights, "filtered": self._filtered, "part": part}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        self._see(state["filtered"], filtered=True)
        self._see(state["heights"], filtered=False)
        self._part = int(state["part"])
