"""What a model is: a list of operations, defaults, and hooks of its training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Layout
from mbtf_fit.ops import Operation
from mbtf_fit.sections import NetworkSection, TrainingSection

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from mbtf_core.data.dataset import Dataset
    from mbtf_fit.pytorch.material import NeuralMaterial

# Options that only some models have, by dotted key; :attr:`Model.takes` names those of a model.
SPECIAL = (
    *("network.channels", "network.width", "network.layers", "network.decoder", "network.activation"),
    *("network.output_channels", "network.output_transform", "network.offset", "network.oversampling"),
    "network.encoding",
    *(f"network.relief.{name}" for name in ("places", "shadow_rays", "hints", "frame", "gate")),
    *("decoder", "training.shared_decoder", "training.materials", "training.own_material"),
    "training.residual_levels",
)
# Those of a network that decodes a pyramid of textures.
PYRAMID = (
    *("network.channels", "network.width", "network.layers", "network.activation", "network.output_channels"),
    *("network.output_transform", "network.oversampling", "network.encoding"),
    "training.residual_levels",
)
SHARED = ("decoder", "training.shared_decoder")


@dataclass(frozen=True)
class Preparation:
    """What a fit knows before its first step.

    Attributes
    ----------
    data : the data set
    queries : the training queries, on the device
    training : options
    unit : typical value of the data in 1/sr
    seed : of the fit
    load : reads the training queries of another folder: (queries, their typical value)
    """

    data: Dataset
    queries: Any
    training: TrainingSection
    unit: float
    seed: int
    load: Any


class Model:
    """A model: what it computes, and how it is trained. An object accompanies one training.

    Subclasses in files of this folder are found by their `name`, a line that begins with ``name = "``; a
    file is a model of its own. Those of other files are given as ``FILE.py:CLASS``, and named as their class
    unless they have a `name`.

    Attributes
    ----------
    name, description : in options and in their help
    layout : of the data that it is trained on
    defaults : options that differ from the general defaults, nested
    takes : the options of :data:`SPECIAL` that it has; others are refused
    reads_geometry : channels that the data's geometry must have, by which users tell it
    calibrates : whether energy calibration follows the training
    """

    name: ClassVar[str]
    description: ClassVar[str]
    layout: ClassVar[Layout] = "shuffled"
    defaults: ClassVar[Mapping[str, Any]] = {}
    takes: ClassVar[Sequence[str]] = PYRAMID
    reads_geometry: ClassVar[Sequence[str]] = ()
    calibrates: ClassVar[bool] = True

    def __init__(self, material: NeuralMaterial) -> None:
        self.material = material

    @classmethod
    def reads(cls, layout: Layout) -> bool:
        """Whether it is trained on data of a layout: slices are queries as well."""
        return layout == cls.layout or (layout, cls.layout) == ("slices", "shuffled")

    @classmethod
    def operations(cls, lattice: Lattice, network: NetworkSection) -> list[Operation]:
        """The model, for texel grids and an architecture."""
        raise NotImplementedError

    def prepare(self, given: Preparation) -> Any:
        """Called once the parameters are initialized: know a surface, build an encoder; returns the
        queries."""
        return given.queries

    def precompute(self, queries: Any, memory: float) -> Any:
        """Called before training: the queries, with what is known of them where it fits in so many bytes."""
        return queries

    def before_step(self, step: int, fraction: float, sigmas: Mapping[str, float], batch: Any) -> Any:
        """Called before each step, with the share of the budget that is spent and the current blur of each
        texture in texels; returns the batch."""
        return batch

    def trained(self) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
        """(texels, network weights) that training changes."""
        texels, weights = self.material.parameter_groups()
        return texels, [p for p in weights if p.requires_grad]

    def parameters(self) -> dict[str, Tensor]:
        """Parameters besides those of the material, by name."""
        return {}

    def predict(self, batch: Any) -> tuple[Tensor, Any]:
        """Values of a batch in 1/sr, and the queries that they are compared with."""
        return self.material(batch.u, batch.sigma, batch.omega_i, batch.omega_o), batch

    def write_textures(self, queries: Any) -> bool:
        """Write textures that are not parameters; whether there are any."""
        return False

    def state(self) -> dict[str, Tensor]:
        """Tensors of a checkpoint, besides parameters."""
        return {}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Inverse of :meth:`state`."""


def generator_of(seed: int) -> torch.Generator:
    """PyTorch's random numbers of a seed."""
    import torch

    return torch.Generator().manual_seed(seed)
