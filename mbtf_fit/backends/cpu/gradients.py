"""Gradients of a batch by the kernel: every thread computes a part of the queries.

The kernel implements the quadratic losses itself: forward and backward pass, block by block. With any other
loss a part is cut into pieces: forward pass, loss in PyTorch, and backward pass while the activations are
still in the cache. Each thread has its own sums, which are added in a fixed order, so that the result depends
on the number of threads only.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from mbtf_fit.backends.cpu.model import NativeModel, aligned, pointers, share
from mbtf_fit.data.queries import TrainingQueries
from mbtf_fit.native.library import MAX_LEVELS, GradientSums, QuadraticLoss, QueryPointers
from mbtf_fit.objective.losses import Objective, Quadratic
from mbtf_fit.objective.parallel import Workers

# Bytes of activations per piece: about a core's part of the last-level cache.
_PIECE_BYTES = 6 << 20


def query_pointers(batch: TrainingQueries, start: int, stop: int) -> QueryPointers:
    """Addresses of queries [start, stop) of a batch; its tensors are contiguous float32."""
    arrays = (batch.u, batch.sigma, batch.omega_i, batch.omega_o)
    addresses = [a.data_ptr() + 4 * start * a.stride(0) for a in arrays]
    if batch.hints is not None:
        addresses.append(batch.hints.data_ptr() + 4 * start * batch.hints.stride(0))
    return QueryPointers(stop - start, *addresses)


class _Sums:
    """Sums of gradients of one thread, and its working memory for a piece of queries."""

    def __init__(self, native: NativeModel, piece: int) -> None:
        lanes = int(native.kernel.library.mbtf_lanes())
        self.textures = [
            aligned(t.packing.texels * (-(-t.texels.shape[1] // 8) * 8)) for t in native.textures
        ]
        self.networks = [
            aligned(lanes * sum(w.numel() for w in weights)) for weights in native.network_weights()
        ]
        addresses = [t.data_ptr() for t in self.textures], [t.data_ptr() for t in self.networks]
        texture, network = ([*a, 0][:2] for a in addresses)
        # Without sums the kernel leaves out the gradients of the weights.
        network = [0, 0] if native.frozen else network
        self.depth_weights = torch.zeros(MAX_LEVELS)
        self.pointers = GradientSums(*texture, *network, self.depth_weights.data_ptr())
        self.state = native.state(piece)
        self.scratch = aligned(int(native.kernel.library.mbtf_scratch_floats()))
        self.out = torch.empty(max(piece, 2 * native.kernel.block), 3)


def quadratic_form(loss: Quadratic) -> QuadraticLoss:
    """A quadratic loss, as the kernel takes it."""
    bound = (ctypes.c_float * 3)(*(loss.bound or (0.0, 0.0, 0.0)))
    return QuadraticLoss(loss.relative, loss.squared, loss.chroma, loss.scale, bound, loss.bound is not None)


class NativeGradients:
    """Computes gradients of one model for many batches; holds the memory for it.

    Attributes
    ----------
    textures, networks : gradients by the tables and by the weights of each network, of the last batch
    depth_weights : gradients by the depth weights of relief
    """

    def __init__(self, native: NativeModel) -> None:
        self.native = native
        self.textures = [torch.empty_like(t.texels) for t in native.textures]
        self.networks = [[torch.empty_like(w) for w in n] for n in native.network_weights()]
        self.depth_weights = torch.zeros(MAX_LEVELS)
        block = native.kernel.block
        per_block = 4 * native.kernel.library.mbtf_state_floats(ctypes.byref(native.description))
        self.piece = block * max(4, _PIECE_BYTES // per_block)
        self._sums: list[_Sums] = []

    def _collect(self, sums: Sequence[_Sums], workers: Workers) -> None:
        """Move the threads' sums to the gradients."""
        library = self.native.kernel.library
        for k, gradients in enumerate([] if self.native.frozen else self.networks):
            description = (self.native.description.decoder, self.native.description.offset)[k]
            addresses = pointers([s.networks[k] for s in sums])
            library.mbtf_collect_weights(ctypes.byref(description), addresses, len(sums), pointers(gradients))
        workers.each(lambda part: self._collect_textures(sums, part))

    def _collect_textures(self, sums: Sequence[_Sums], part: int) -> None:
        kernel, count = self.native.kernel, len(sums)
        for k, gradient in enumerate(self.textures):
            texels, channels = gradient.shape
            addresses = pointers([s.textures[k] for s in sums])
            edges = share(texels, part, count)
            kernel.library.mbtf_collect(
                kernel.variant, addresses, count, channels, *edges, gradient.data_ptr()
            )

    def weights(self) -> dict[Tensor, Tensor]:
        """Gradients by all parameters that are trained but the texels."""
        found: dict[Tensor, Tensor] = {}
        if not self.native.frozen:
            for network, gradients in zip(self.native.networks, self.networks, strict=True):
                found.update(zip(network.parameters(), gradients, strict=True))
        if (weights := self.native.depth_weights) is not None:
            found[weights] = self.depth_weights[: len(weights)].contiguous()
        return found

    def compute(self, objective: Objective, batch: TrainingQueries, workers: Workers) -> Tensor:
        """Mean loss of a batch; the gradients by tables and weights are left in :attr:`textures` and
        :attr:`networks`."""
        if len(self._sums) != workers.count:
            self._sums = [_Sums(self.native, self.piece) for _ in range(workers.count)]
        self.native.refresh()
        quadratic = objective.quadratic()

        def work(k: int) -> Tensor:
            first, last = share(len(batch), k, workers.count)
            if quadratic is not None:
                return self._learn(self._sums[k], quadratic, batch, first, last)
            total = torch.zeros(())
            for start in range(first, last, self.piece):
                stop = min(start + self.piece, last)
                total += self._piece(self._sums[k], objective, batch, start, stop)
            return total

        losses = workers.each(work)
        self._collect(self._sums, workers)
        self.depth_weights = torch.stack([s.depth_weights for s in self._sums]).sum(0)
        for sums in self._sums:
            sums.depth_weights.zero_()
        # In a fixed order, which does not depend on which thread finishes first.
        return sum(losses[1:], losses[0])

    def _learn(self, sums: _Sums, loss: Quadratic, batch: TrainingQueries, start: int, stop: int) -> Tensor:
        native = self.native
        form = quadratic_form(loss)
        queries = query_pointers(batch, start, stop)
        weight = 1.0 / (3 * len(batch))
        total = native.kernel.library.mbtf_learn(
            native.kernel.variant,
            ctypes.byref(native.description),
            ctypes.byref(queries),
            batch.value.data_ptr() + 12 * start,
            ctypes.byref(form),
            weight,
            sums.state.data_ptr(),
            sums.scratch.data_ptr(),
            sums.out.data_ptr(),
            ctypes.byref(sums.pointers),
        )
        return torch.tensor(weight * total)

    def _piece(
        self, sums: _Sums, objective: Objective, batch: TrainingQueries, start: int, stop: int
    ) -> Tensor:
        native, part = self.native, batch.slice(start, stop)
        queries = query_pointers(batch, start, stop)
        out = sums.out[: len(part)]
        native.forward(queries, sums.state, out.data_ptr(), keep=True)
        prediction = out.detach().requires_grad_()
        loss = objective(prediction, part) * (len(part) / len(batch))
        (by_value,) = torch.autograd.grad(loss, prediction)
        native.kernel.library.mbtf_backward(
            native.kernel.variant,
            ctypes.byref(native.description),
            ctypes.byref(queries),
            sums.state.data_ptr(),
            by_value.contiguous().data_ptr(),
            sums.scratch.data_ptr(),
            ctypes.byref(sums.pointers),
        )
        return loss.detach()
