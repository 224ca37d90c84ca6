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
    directions_size,
)
from mbtf_fit.models.hierarchical import Hierarchical
from mbtf_fit.models.inception import InceptionDecoder
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
# Those of the model `hierarchical`: its encodings are supported by :func:`supports_patches`.
_SUPPORTED_PATCHES: dict[str, tuple[Any, ...]] = {
    **{name: values for name, values in _SUPPORTED.items() if name != "encoding"},
    "decoder": ("mlp", "inception"),
    "output_transform": ("expm1", "fourth-root"),
}
_SIZES = {"channels", "width", "layers", "oversampling", "relief"}


def supports(model: NeuralMaterial) -> bool:
    """Whether the kernel can evaluate a model on single queries."""
    known = type(model) in (Neumip, NeumipBaseline, LearnedRelief, Relief)
    return known and _has(model, _SUPPORTED) and _fits(model)


def supports_patches(model: NeuralMaterial) -> bool:
    """Whether the kernel can evaluate a model on patches (:mod:`mbtf_fit.native.patches`)."""
    encoding = model.network.encoding
    return (
        type(model) is Hierarchical
        and _has(model, _SUPPORTED_PATCHES)
        and (encoding.position == 0 or (encoding.pi and not encoding.raw))
        and _fits(model)
    )


def _has(model: NeuralMaterial, supported: dict[str, tuple[Any, ...]]) -> bool:
    """Whether all options of the architecture have supported values."""
    options = model.network.model_dump()
    return options.keys() == _SUPPORTED.keys() | _SIZES and all(
        options[name] in values for name, values in supported.items()
    )


def _fits(model: NeuralMaterial) -> bool:
    """Whether a model is on the CPU, and within the kernel's sizes."""
    textures = model.textures()
    tensors = [*model.parameters(), *(t.table for t in textures)]
    weights = network_weights(model)
    return (
        all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)
        and all(len(network) <= 2 * MAX_LAYERS for network in weights)
        and all(max(w.shape) <= MAX_WIDTH for network in weights for w in network)
        and all(t.texels.shape[1] <= MAX_CHANNELS and len(t.packing.shapes) <= MAX_LEVELS for t in textures)
        and all(t.packing.texels < 1 << 31 for t in textures)
    )


def networks(model: NeuralMaterial) -> list[Mlp]:
    """Fully connected networks that the kernel evaluates: the decoder if it is one, and the offset network if
    there is one."""
    decoder = [model.decoder] if isinstance(model.decoder, Mlp) else []
    return [*decoder, *([] if model.network.offset == "none" else [model.offset_network])]


def network_weights(model: NeuralMaterial) -> list[list[Tensor]]:
    """Weight 0 (outputs, inputs), bias 0, ... of the networks that the kernel evaluates: the decoder, and the
    offset network if there is one. Of an inception decoder, they are those of its first layer for inputs
    that differ between the positions of a patch, with biases 0."""
    found = [[p.detach() for p in network.parameters()] for network in networks(model)]
    if isinstance(model.decoder, InceptionDecoder):
        first = model.decoder.first
        found.insert(0, [first.matrix[:, : model.decoder.features].detach(), torch.zeros_like(first.bias)])
    return found


def inception_parameters(decoder: InceptionDecoder) -> list[Tensor]:
    """Weight and bias of each convolution behind the first layer."""
    return [*decoder.modules_.parameters(), *decoder.last.parameters()]


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
    `description` is what the C functions take; the networks of a `frozen` model are not trained."""

    def __init__(self, kernel: Kernel, model: NeuralMaterial) -> None:
        self.kernel = kernel
        self.model = model
        self.frozen = model.frozen
        self.description = d = Model()
        d.offset_scale, d.grazing, d.aspect = OFFSET_SCALE, GRAZING, model.lattice.aspect
        encoding, relief = model.network.encoding, model.network.relief
        d.coordinates, d.half_vector = direction_size(encoding), encoding.half_vector
        if isinstance(model, Relief):
            d.irradiance_scale = IRRADIANCE_SCALE
            d.hints, d.frame, d.gate = relief.hints, relief.frame, relief.gate
        if isinstance(model, LearnedRelief):
            d.height_scale, d.least_facing = HEIGHT_SCALE, LEAST_FACING
        if isinstance(model, Hierarchical):
            d.fourth_root = model.network.output_transform == "fourth-root"
            d.bands, d.inputs = encoding.position, directions_size(encoding)
        self._inception: tuple[InceptionDecoder, Tensor] | None = None
        if isinstance(model.decoder, InceptionDecoder):
            self._describe_inception(model.decoder)
        self._networks: list[tuple[Network, Tensor]] = []
        for weights, target in zip(network_weights(model), (d.decoder, d.offset), strict=False):
            widths = [weights[0].shape[1], *(len(w) for w in weights[::2])]
            target.layers, target.wanted = len(weights) // 2, model.textures()[0].texels.shape[1]
            target.widths[: len(widths)] = widths
            packed = aligned(kernel.library.mbtf_packed_floats(ctypes.byref(target)))
            target.packed = packed.data_ptr()
            self._networks.append((target, packed))
        self._textures = list(zip(model.textures(), (d.pyramid, d.offset_texture), strict=False))
        for texture, layout in self._textures:
            shapes = texture.packing.shapes
            layout.levels, layout.channels = len(shapes), texture.texels.shape[1]
            layout.rows[: len(shapes)] = [rows for rows, _ in shapes]
            layout.columns[: len(shapes)] = [columns for _, columns in shapes]
            layout.starts[: len(shapes) + 1] = texture.packing.starts
        self.refresh()

    def _describe_inception(self, decoder: InceptionDecoder) -> None:
        target, module = self.description.inception, decoder.modules_[0]
        target.modules, target.width = len(decoder.modules_), len(decoder.first.bias)
        for name in ("one", "before3", "three", "before5", "five"):
            setattr(target, name, len(getattr(module, name).bias))
        self.description.inputs = target.width
        packed = aligned(self.kernel.library.mbtf_inception_floats(ctypes.byref(target)))
        target.packed = packed.data_ptr()
        self._inception = decoder, packed

    def refresh(self) -> None:
        """Copy the current weights, and the tables that lookups read."""
        library, variant = self.kernel.library, self.kernel.variant
        self.description.unit = float(self.model.unit)
        for weights, (target, packed) in zip(network_weights(self.model), self._networks, strict=True):
            held = [w.contiguous() for w in weights]
            library.mbtf_pack(variant, ctypes.byref(target), pointers(held), packed.data_ptr())
        if self._inception is not None:
            decoder, packed = self._inception
            held = [p.detach().contiguous() for p in inception_parameters(decoder)]
            inception = ctypes.byref(self.description.inception)
            library.mbtf_pack_inception(variant, inception, pointers(held), packed.data_ptr())
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
