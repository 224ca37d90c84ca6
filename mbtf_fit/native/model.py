"""Description of a PyTorch model for the kernel."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from mbtf_fit.config import EncodingSection
from mbtf_fit.models.constants import (
    GRAZING,
    HEIGHT_SCALE,
    IRRADIANCE_SCALE,
    LEAST_FACING,
    OFFSET_SCALE,
    direction_size,
)
from mbtf_fit.models.interface import NeuralMaterial
from mbtf_fit.models.learned_relief import LearnedRelief
from mbtf_fit.models.mlp import Mlp
from mbtf_fit.models.neumip import Neumip, NeumipBaseline
from mbtf_fit.models.relief import Relief
from mbtf_fit.native.library import (
    MAX_CHANNELS,
    MAX_LAYERS,
    MAX_LEVELS,
    MAX_WIDTH,
    Kernel,
    Model,
    Network,
    QueryPointers,
)

# Values of the architecture's options that the kernel supports; sizes are limited by the kernel's constants.
_SUPPORTED: dict[str, tuple[Any, ...]] = {
    "decoder": ("mlp",),
    "activation": ("relu",),
    "output_channels": (3,),
    "output_transform": ("expm1",),
    "offset": ("depth", "none"),
    "blending": ("blend",),
    "encoding": tuple(
        EncodingSection(direction_xyz=xyz, half_vector=half).model_dump()
        for xyz in (False, True)
        for half in (False, True)
    ),
}
_SIZES = {"channels", "width", "layers", "oversampling", "relief"}


def supports(model: NeuralMaterial) -> bool:
    """Whether the kernel can evaluate a model."""
    if type(model) not in (Neumip, NeumipBaseline, LearnedRelief, Relief):
        return False
    options, textures = model.network.model_dump(), model.textures()
    tensors = [*model.parameters(), *(t.table for t in textures)]
    return (
        options.keys() == _SUPPORTED.keys() | _SIZES
        and all(options[name] in supported for name, supported in _SUPPORTED.items())
        and all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)
        and all(len(network.weights) <= MAX_LAYERS for network in networks(model))
        and all(max(w.shape) <= MAX_WIDTH for network in networks(model) for w in network.weights)
        and all(t.texels.shape[1] <= MAX_CHANNELS and len(t.packing.shapes) <= MAX_LEVELS for t in textures)
        and all(t.packing.texels < 1 << 31 for t in textures)
    )


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


def share(n: int, part: int, parts: int, *, whole: bool = False) -> tuple[int, int]:
    """(first, last) of `n` things for one of several threads; `whole`: all for the first one."""
    if whole:
        return 0, 0 if part else n
    return n * part // parts, n * (part + 1) // parts


class NativeModel:
    """A supported model, evaluated by the kernel; :meth:`refresh` copies the model's current weights. Its
    `description` is what the C functions take."""

    def __init__(self, kernel: Kernel, model: NeuralMaterial) -> None:
        self.kernel = kernel
        self.model = model
        self.description = d = Model()
        d.offset_scale, d.grazing, d.aspect = OFFSET_SCALE, GRAZING, model.lattice.aspect
        encoding, relief = model.network.encoding, model.network.relief
        d.coordinates, d.half_vector = direction_size(encoding), encoding.half_vector
        if isinstance(model, Relief):
            d.irradiance_scale = IRRADIANCE_SCALE
            d.hints, d.frame, d.gate = relief.hints, relief.frame, relief.gate
        if isinstance(model, LearnedRelief):
            d.height_scale, d.least_facing = HEIGHT_SCALE, LEAST_FACING
        self._networks: list[tuple[Mlp, Network, Tensor]] = []
        for network, target in zip(networks(model), (d.decoder, d.offset), strict=False):
            widths = [network.weights[0].shape[1], *(len(w) for w in network.weights)]
            target.layers, target.wanted = len(network.weights), model.textures()[0].texels.shape[1]
            target.widths[: len(widths)] = widths
            packed = aligned(kernel.library.mbtf_packed_floats(ctypes.byref(target)))
            target.packed = packed.data_ptr()
            self._networks.append((network, target, packed))
        self._textures = list(zip(model.textures(), (d.pyramid, d.offset_texture), strict=False))
        for texture, layout in self._textures:
            shapes = texture.packing.shapes
            layout.levels, layout.channels = len(shapes), texture.texels.shape[1]
            layout.rows[: len(shapes)] = [rows for rows, _ in shapes]
            layout.columns[: len(shapes)] = [columns for _, columns in shapes]
            layout.starts[: len(shapes) + 1] = texture.packing.starts
        self.refresh()

    def refresh(self) -> None:
        """Copy the current weights, and the tables that lookups read."""
        library, variant = self.kernel.library, self.kernel.variant
        assert isinstance(self.model, Neumip)
        self.description.unit = float(self.model.unit)
        for network, target, packed in self._networks:
            held = [p.detach().contiguous() for p in network.parameters()]
            library.mbtf_pack(variant, ctypes.byref(target), pointers(held), packed.data_ptr())
        if isinstance(self.model, Relief):
            self._depth_weights = self.model.depth_weights.detach().contiguous()
            self.description.depth_weights = self._depth_weights.data_ptr()
        # Kept: the description has their addresses.
        self._tables = [texture.table.detach().contiguous() for texture, _ in self._textures]
        for (_, layout), table in zip(self._textures, self._tables, strict=True):
            layout.table = table.data_ptr()

    def state(self, queries: int) -> Tensor:
        """Memory for the activations of a number of queries."""
        blocks = -(-queries // self.kernel.block)
        return aligned(blocks * int(self.kernel.library.mbtf_state_floats(ctypes.byref(self.description))))

    def forward(
        self, queries: QueryPointers, state: Tensor, out: int, *, clamp: bool = False, keep: bool = False
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
