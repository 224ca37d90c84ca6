"""Description of a PyTorch model for the kernel."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from mbtf_fit.config import EncodingSection
from mbtf_fit.models.constants import GRAZING, OFFSET_SCALE, direction_size
from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.models.mlp import Mlp
from mbtf_fit.models.neumip import Neumip, NeumipBaseline
from mbtf_fit.models.textures import FeatureTextures
from mbtf_fit.native.library import (
    MAX_CHANNELS,
    MAX_LAYERS,
    MAX_LEVELS,
    MAX_WIDTH,
    Kernel,
    Model,
    Network,
    QueryPointers,
    Textures,
)

# Values of the architecture's options that the kernel supports; sizes are limited by the kernel's constants.
_SUPPORTED: dict[str, tuple[Any, ...]] = {
    "decoder": ("mlp",),
    "activation": ("relu",),
    "output_channels": (3,),
    "output_transform": ("expm1",),
    "offset": ("depth", "none"),
    "blending": ("blend",),
    "encoding": tuple(EncodingSection(direction_xyz=xyz).model_dump() for xyz in (False, True)),
}
_SIZES = {"channels", "width", "layers"}


def unsupported_reason(model: NeuralMaterial) -> str | None:
    """Why the kernel cannot evaluate a model; None where it can."""
    if type(model) not in (Neumip, NeumipBaseline):
        return f"it does not support the model {model.name}"
    options = model.network.model_dump()
    for name, supported in _SUPPORTED.items():
        if options.pop(name) not in supported:
            return f"it does not support network.{name}={getattr(model.network, name)}"
    if options.keys() - _SIZES:
        return f"it does not support network.{min(options.keys() - _SIZES)}"
    tensors = [*model.parameters(), *(t.table for t in model.textures())]
    if any(t.device.type != "cpu" or t.dtype != torch.float32 for t in tensors):
        return "it runs on CPUs, in float32"
    for network in networks(model):
        if len(network.weights) > MAX_LAYERS or max(max(w.shape) for w in network.weights) > MAX_WIDTH:
            return f"its networks have at most {MAX_LAYERS} layers of {MAX_WIDTH} features"
    for texture in model.textures():
        if texture.texels.shape[1] > MAX_CHANNELS or len(texture.packing.shapes) > MAX_LEVELS:
            return f"its textures have at most {MAX_LEVELS} levels of {MAX_CHANNELS} channels"
        if texture.packing.texels >= 1 << 31:
            return "its textures have less than 2^31 texels"
    return None


def networks(model: NeuralMaterial) -> list[Mlp]:
    """Networks that the kernel evaluates: the decoder, and the offset network if there is one."""
    assert isinstance(model, Neumip)
    assert isinstance(model.decoder, Mlp)
    return [model.decoder, *([] if model.network.offset == "none" else [model.offset_network])]


def pointers(tensors: list[Tensor]) -> Any:
    """Addresses of tensors, as the kernel takes them."""
    return (ctypes.c_void_p * len(tensors))(*(t.data_ptr() for t in tensors))


def aligned(floats: int) -> Tensor:
    """Zeros (floats,) that begin at a cache line."""
    whole = torch.zeros(floats + 16)
    skip = (-whole.data_ptr() // 4) % 16
    return whole[skip : skip + floats]


class NativeModel:
    """A supported model, evaluated by the kernel.

    :meth:`refresh` copies the model's current weights.

    Attributes
    ----------
    description : as the C functions take it
    """

    def __init__(self, kernel: Kernel, model: NeuralMaterial) -> None:
        self.kernel = kernel
        self.model = model
        self.description = Model()
        self.description.offset_scale, self.description.grazing = OFFSET_SCALE, GRAZING
        self.description.aspect = model.lattice.aspect
        self.description.coordinates = direction_size(model.network.encoding)
        self._packed: list[Tensor] = []
        for network, target in zip(networks(model), self._targets(), strict=False):
            widths = [network.weights[0].shape[1], *(len(w) for w in network.weights)]
            target.layers, target.wanted = len(network.weights), model.textures()[0].texels.shape[1]
            target.widths[: len(widths)] = widths
            packed = aligned(kernel.library.mbtf_packed_floats(ctypes.byref(target)))
            target.packed = packed.data_ptr()
            self._packed.append(packed)
        for texture, layout in zip(model.textures(), self._layouts(), strict=False):
            shapes = texture.packing.shapes
            layout.levels, layout.channels = len(shapes), texture.texels.shape[1]
            layout.rows[: len(shapes)] = [rows for rows, _ in shapes]
            layout.columns[: len(shapes)] = [columns for _, columns in shapes]
            layout.starts[: len(shapes) + 1] = texture.packing.starts
        self.refresh()

    def _targets(self) -> list[Network]:
        return [self.description.decoder, self.description.offset]

    def _layouts(self) -> list[Textures]:
        return [self.description.pyramid, self.description.offset_texture]

    def refresh(self) -> None:
        """Copy the current weights, and the tables that lookups read."""
        library, variant = self.kernel.library, self.kernel.variant
        assert isinstance(self.model, Neumip)
        self.description.unit = float(self.model.unit)
        self._kept: list[Tensor] = []
        for network, target, packed in zip(networks(self.model), self._targets(), self._packed, strict=False):
            held = [p.detach().contiguous() for p in network.parameters()]
            library.mbtf_pack(variant, ctypes.byref(target), pointers(held), packed.data_ptr())
        for texture, layout in zip(self.model.textures(), self._layouts(), strict=False):
            table = texture.table.detach().contiguous()
            self._kept.append(table)
            layout.table = table.data_ptr()

    @property
    def textures(self) -> list[FeatureTextures]:
        """The model's textures: the pyramid, then the offset's."""
        return self.model.textures()

    def state(self, queries: int) -> Tensor:
        """Memory for the activations of a number of queries."""
        blocks = -(-queries // self.kernel.block)
        return aligned(blocks * int(self.kernel.library.mbtf_state_floats(ctypes.byref(self.description))))

    def forward(
        self,
        queries: QueryPointers,
        state: Tensor,
        out: int,
        *,
        clamp: bool = False,
        keep: bool = False,
    ) -> None:
        """Values (n, 3), written to the address `out`; `keep` activations of all blocks for backward, else
        `state` needs room for one block."""
        self.kernel.library.mbtf_forward(
            self.kernel.variant,
            ctypes.byref(self.description),
            ctypes.byref(queries),
            clamp,
            keep,
            state.data_ptr(),
            out,
        )
