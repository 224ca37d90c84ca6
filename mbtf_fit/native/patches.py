"""The hierarchical model by the kernel: values of single queries, and gradients of patches.

The kernel computes all that depends on a position. What the positions of a patch share is computed here, in
PyTorch: encoded light and view, what they add to the first layer of an inception decoder, and the factors of
the position's encoding.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor
from torch.nn.functional import linear

from mbtf_fit.data.images import Patches
from mbtf_fit.models.encodings import position_factors
from mbtf_fit.models.hierarchical import Hierarchical
from mbtf_fit.models.inception import InceptionDecoder
from mbtf_fit.native.gradients import CollectedGradients, Sums, quadratic_form, total_of
from mbtf_fit.native.library import PatchPointers
from mbtf_fit.native.model import NativeModel, aligned, inception_parameters, pointers, share
from mbtf_fit.objective.losses import Objective
from mbtf_fit.objective.parallel import Workers

# Positions of a group of patches, whose activations stay in the cache.
_GROUP = 2048
# Bytes of activations whose loss PyTorch computes at once: its operations on few values are mostly overhead.
_PIECE_BYTES = 24 << 20


class PatchInputs:
    """Patches as the kernel takes them; holds the tensors whose addresses they are.

    Parameters
    ----------
    u : (items, rows, columns, 2) positions; sigma : (items,); omega_i, omega_o : (items, 3)
    """

    def __init__(
        self, model: Hierarchical, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor
    ) -> None:
        encoding, decoder = model.network.encoding, model.decoder
        self.directions = model.directions(omega_i, omega_o).detach()
        inputs = self.directions
        if isinstance(decoder, InceptionDecoder):
            matrix = decoder.first.matrix[:, decoder.features :]
            inputs = linear(self.directions, matrix, decoder.first.bias).detach()
        factors = sigma
        if encoding.position:
            factors = position_factors(model.level(sigma), model.lattice.aspect, encoding)
        self._tensors = [t.contiguous() for t in (u, sigma, omega_o, factors, inputs)]
        self.rows, self.columns = u.shape[1:3]
        self.group = max(1, _GROUP // (self.rows * self.columns))

    def pointers(self, start: int, stop: int) -> PatchPointers:
        """Addresses of items [start, stop)."""
        addresses = (t.data_ptr() + 4 * start * t.stride(0) for t in self._tensors)
        return PatchPointers(stop - start, self.rows, self.columns, *addresses)


def _floats(native: NativeModel, inputs: PatchInputs) -> tuple[int, int]:
    """Floats that a group of patches needs for its activations, and for scratch."""
    library, description = native.kernel.library, ctypes.byref(native.description)
    size = (inputs.rows, inputs.columns, inputs.group)
    return (
        int(library.mbtf_patch_state_floats(description, *size)),
        int(library.mbtf_patch_scratch_floats(description, *size)),
    )


def evaluate(native: NativeModel, u: Tensor, sigma: Tensor, omega_i: Tensor, omega_o: Tensor) -> Tensor:
    """Values (n, 3) of the hierarchical model at single queries, clamped at 0."""
    model = native.model
    assert isinstance(model, Hierarchical)
    places = model.neighborhood(u, sigma) if model.margin else u[:, None, None]
    inputs = PatchInputs(model, places, sigma, omega_i, omega_o)
    out = torch.empty(len(u), 3)
    state = aligned(_floats(native, inputs)[0])
    forward(native, inputs, 0, len(u), state, out, clamp=True)
    return out


def forward(
    native: NativeModel,
    inputs: PatchInputs,
    start: int,
    stop: int,
    state: Tensor,
    out: Tensor,
    *,
    clamp: bool = False,
    keep: bool = False,
) -> None:
    """Values of items [start, stop), without margins, written to `out`; `keep` the activations of all groups
    for backward, else `state` needs room for one group."""
    native.kernel.library.mbtf_patch_forward(
        native.kernel.variant,
        ctypes.byref(native.description),
        ctypes.byref(inputs.pointers(start, stop)),
        inputs.group,
        clamp,
        keep,
        state.data_ptr(),
        out.data_ptr(),
    )


class _PatchSums(Sums):
    """Sums, and working memory for some groups of patches of one shape."""

    def __init__(self, native: NativeModel, inputs: PatchInputs, values: int) -> None:
        super().__init__(native)
        self.inception: Tensor | None = None
        if isinstance(native.model.decoder, InceptionDecoder):
            numbers = sum(p.numel() for p in inception_parameters(native.model.decoder))
            self.inception = aligned(int(native.kernel.library.mbtf_lanes()) * numbers)
            self.pointers.inception = self.inception.data_ptr()
        state, scratch = _floats(native, inputs)
        groups = max(1, _PIECE_BYTES // (4 * state))
        # Items whose loss PyTorch computes at once.
        self.piece = groups * inputs.group
        self.state, self.scratch = aligned(groups * state), aligned(scratch)
        self.out = torch.empty(max(self.piece, 2 * inputs.group) * values)


class PatchGradients(CollectedGradients):
    """Computes gradients of one hierarchical model for many batches; holds the memory for it."""

    def __init__(self, native: NativeModel) -> None:
        super().__init__(native)
        assert isinstance(native.model, Hierarchical)
        self.model = native.model
        self._sums: list[_PatchSums] = []
        self._shape: tuple[int, ...] = ()
        self._inception: list[Tensor] = []
        self._shared: tuple[Tensor, Tensor] | None = None
        if isinstance(self.model.decoder, InceptionDecoder):
            self._inception = [torch.empty_like(p) for p in inception_parameters(self.model.decoder)]

    def weights(self) -> dict[Tensor, Tensor]:
        decoder = self.model.decoder
        if not isinstance(decoder, InceptionDecoder):
            return super().weights()
        assert self._shared is not None
        by_inputs, directions = self._shared
        matrix = torch.cat([self.networks[0][0], by_inputs.T @ directions], 1)
        found = {decoder.first.weight: matrix[:, :, None, None], decoder.first.bias: by_inputs.sum(0)}
        found.update(zip(inception_parameters(decoder), self._inception, strict=True))
        if self.model.network.offset != "none":
            found.update(zip(self.model.offset_network.parameters(), self.networks[1], strict=True))
        return found

    def compute(self, objective: Objective, batch: Patches, workers: Workers) -> Tensor:
        """Mean loss of a batch; the gradients are left in :attr:`textures` and :meth:`weights`."""
        self.native.refresh()
        inputs = PatchInputs(self.model, batch.u, batch.sigma, batch.omega_i, batch.omega_o)
        shape = (workers.count, inputs.rows, inputs.columns)
        if self._shape != shape:
            values = batch.value[0].numel()
            self._sums = [_PatchSums(self.native, inputs, values) for _ in range(workers.count)]
            self._shape = shape
        by_inputs = torch.zeros(len(batch), int(self.native.description.inputs))

        def work(k: int) -> Tensor:
            sums, total = self._sums[k], torch.zeros(())
            first, last = share(len(batch), k, workers.count)
            if objective.quadratic() is not None:
                return self._learn(sums, objective, batch, inputs, by_inputs, first, last)
            for start in range(first, last, sums.piece):
                stop = min(start + sums.piece, last)
                total += self._piece(sums, objective, batch, inputs, by_inputs, start, stop)
            return total

        losses = workers.each(work)
        self.collect(self._sums, workers)
        if self._inception:
            addresses = pointers([s.inception for s in self._sums if s.inception is not None])
            self.native.kernel.library.mbtf_collect_inception(
                ctypes.byref(self.native.description.inception),
                addresses,
                len(self._sums),
                pointers(self._inception),
            )
            self._shared = by_inputs, inputs.directions
        return total_of(losses)

    def _learn(
        self,
        sums: _PatchSums,
        objective: Objective,
        batch: Patches,
        inputs: PatchInputs,
        by_inputs: Tensor,
        start: int,
        stop: int,
    ) -> Tensor:
        native, quadratic = self.native, objective.quadratic()
        assert quadratic is not None
        weight = 1.0 / batch.value.numel()
        total = native.kernel.library.mbtf_patch_learn(
            native.kernel.variant,
            ctypes.byref(native.description),
            ctypes.byref(inputs.pointers(start, stop)),
            inputs.group,
            batch.value.data_ptr() + 4 * start * batch.value.stride(0),
            ctypes.byref(quadratic_form(quadratic)),
            weight,
            sums.state.data_ptr(),
            sums.out.data_ptr(),
            by_inputs.data_ptr() + 4 * start * by_inputs.stride(0),
            sums.scratch.data_ptr(),
            ctypes.byref(sums.pointers),
        )
        return torch.tensor(weight * total)

    def _piece(
        self,
        sums: _PatchSums,
        objective: Objective,
        batch: Patches,
        inputs: PatchInputs,
        by_inputs: Tensor,
        start: int,
        stop: int,
    ) -> Tensor:
        native, part = self.native, batch.slice(start, stop)
        out = sums.out[: part.value.numel()]
        forward(native, inputs, start, stop, sums.state, out, keep=True)
        prediction = out.detach().view_as(part.value).requires_grad_()
        loss = objective(prediction, part) * (len(part) / len(batch))
        (by_value,) = torch.autograd.grad(loss, prediction)
        native.kernel.library.mbtf_patch_backward(
            native.kernel.variant,
            ctypes.byref(native.description),
            ctypes.byref(inputs.pointers(start, stop)),
            inputs.group,
            sums.state.data_ptr(),
            by_value.contiguous().data_ptr(),
            by_inputs.data_ptr() + 4 * start * by_inputs.stride(0),
            sums.scratch.data_ptr(),
            ctypes.byref(sums.pointers),
        )
        return loss.detach()
