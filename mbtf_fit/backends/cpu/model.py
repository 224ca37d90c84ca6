"""Description of a material for the kernel."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from mbtf_fit.backends.cpu.pattern import Pattern, match
from mbtf_fit.native.library import (
    MAX_CHANNELS,
    MAX_LAYERS,
    MAX_LEVELS,
    MAX_WIDTH,
    Kernel,
    ModelStruct,
    NetworkStruct,
    QueryPointers,
)
from mbtf_fit.ops.constants import HEIGHT_SCALE, LEAST_FACING
from mbtf_fit.pytorch.material import NeuralMaterial
from mbtf_fit.surface.hints import describe_textures


def pattern_of(material: NeuralMaterial) -> Pattern | None:
    """The operations of a material as the kernel sees them; None if it cannot evaluate them: they have
    another form, are too large, or lie on another device."""
    found = match(material.operations)
    return found if found is not None and _fits(material) else None


def supports(material: NeuralMaterial) -> bool:
    """Whether the kernel can evaluate a material."""
    return pattern_of(material) is not None


def _fits(material: NeuralMaterial) -> bool:
    """Whether a material is on the CPU, and within the kernel's sizes."""
    textures = material.textures()
    tensors = [*material.parameters(), *(t.table for t in textures)]
    weights = [[*network.parameters()] for network in material.networks().values()]
    return (
        all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)
        and all(len(network) <= 2 * MAX_LAYERS for network in weights)
        and all(max(w.shape) <= MAX_WIDTH for network in weights for w in network)
        and all(t.texels.shape[1] <= MAX_CHANNELS and len(t.packing.shapes) <= MAX_LEVELS for t in textures)
        and all(t.packing.texels < 1 << 31 for t in textures)
    )


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
    """A material whose operations the kernel knows; :meth:`refresh` copies its current weights. Its
    `description` is what the C functions take; the networks of a `frozen` one are not trained.

    Attributes
    ----------
    pattern : the operations as the kernel sees them
    textures, networks : those that it reads: the features, then what moves lookups; the decoder, then the
    offset
        network
    """

    def __init__(self, kernel: Kernel, material: NeuralMaterial) -> None:
        pattern = pattern_of(material)
        assert pattern is not None, "the kernel cannot evaluate these operations"
        self.kernel, self.material, self.pattern = kernel, material, pattern
        self.frozen = material.frozen
        features = material.texture(pattern.lookup.textures)
        self.textures = [features, *(t for t in material.textures() if t is not features)]
        names = [pattern.decoder, *([] if pattern.offset_network is None else [pattern.offset_network])]
        self.networks = [material.get_submodule(op.weights) for op in names]
        self.description = d = ModelStruct()
        d.aspect = material.lattice.aspect
        d.coordinates, d.half_vector = pattern.coordinates, pattern.half_vector
        d.irradiance_scale, d.depth_scale = pattern.irradiance_scale, pattern.depth_scale
        d.hints, d.frame, d.fibers, d.gate = pattern.hints, pattern.frame, pattern.fibers, pattern.gate
        if pattern.offset is not None:
            d.offset_scale, d.grazing = pattern.offset.scale, pattern.offset.grazing
        if pattern.displace is not None and pattern.displace.learned is not None:
            d.height_scale, d.least_facing = HEIGHT_SCALE, LEAST_FACING
        self._packed: list[tuple[NetworkStruct, Tensor]] = []
        for weights, target in zip(self.network_weights(), (d.decoder, d.offset), strict=False):
            widths = [weights[0].shape[1], *(len(w) for w in weights[::2])]
            target.layers, target.wanted = len(weights) // 2, self.textures[0].texels.shape[1]
            target.widths[: len(widths)] = widths
            packed = aligned(kernel.library.mbtf_packed_floats(ctypes.byref(target)))
            target.packed = packed.data_ptr()
            self._packed.append((target, packed))
        self._layouts = list(zip(self.textures, (d.pyramid, d.offset_texture), strict=False))
        for texture, layout in self._layouts:
            describe_textures(texture.texels, texture.packing, layout)
        self.refresh()

    def network_weights(self) -> list[list[Tensor]]:
        """Weight 0 (outputs, inputs), bias 0, ... of each network."""
        return [[p.detach() for p in network.parameters()] for network in self.networks]

    @property
    def depth_weights(self) -> Tensor | None:
        """Parameter (levels,) of the displacement, if there is one."""
        displace = self.pattern.displace
        return None if displace is None else self.material.number(displace.weights)

    def refresh(self) -> None:
        """Copy the current weights, and the tables that lookups read."""
        library, variant = self.kernel.library, self.kernel.variant
        self.description.unit = float(self.material.number(self.pattern.unit))
        self.description.most = float(self.material.number(self.pattern.most))
        for weights, (target, packed) in zip(self.network_weights(), self._packed, strict=True):
            held = [w.contiguous() for w in weights]
            library.mbtf_pack(variant, ctypes.byref(target), pointers(held), packed.data_ptr())
        if self.depth_weights is not None:
            self._depth_weights = self.depth_weights.detach().contiguous()
            self.description.depth_weights = self._depth_weights.data_ptr()
        # Kept: the description has their addresses.
        self._tables = [texture.table.detach().contiguous() for texture in self.textures]
        for (_, layout), table in zip(self._layouts, self._tables, strict=True):
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
