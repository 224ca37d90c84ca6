"""The sampler of a stored material (:mod:`mbtf_fit.ops.sampler`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from torch import Tensor

from mbtf_fit.ops import Network, Operation
from mbtf_fit.ops.operation import SAMPLER, input_sizes
from mbtf_fit.ops.sampler import read_sampler, sampler_sizes


@dataclass(frozen=True)
class Sampler:
    """Operations of a sampler, and the tensors of its network by name."""

    operations: list[Operation]
    tensors: dict[str, Tensor]

    @classmethod
    def read(
        cls, description: Mapping[str, Any], tensors: Mapping[str, Tensor], operations: Sequence[Operation]
    ) -> Sampler | None:
        """That of ``material.json``, for a material of some operations; None without.

        Raises
        ------
        ValueError : operations or tensors do not fit
        """
        if SAMPLER not in description:
            return None
        found = read_sampler(description[SAMPLER], operations, tensors)
        mine = {name: tensor.float() for name, tensor in tensors.items() if is_of_sampler(name)}
        sizes = sampler_sizes(operations, found)
        for op in found:
            widths = op.widths(sum(input_sizes(op, sizes))) if isinstance(op, Network) else []
            for k, (inputs, outputs) in enumerate(pairwise(widths)):
                for name, shape in (("weight", (outputs, inputs)), ("bias", (outputs,))):
                    tensor = mine.get(f"{SAMPLER}.{k}.{name}")
                    if tensor is None or tensor.shape != shape:
                        raise ValueError(f"the tensor '{SAMPLER}.{k}.{name}' does not fit the sampler")
        return cls(found, mine)


def is_of_sampler(name: str) -> bool:
    """Whether a tensor is one of the sampler's network."""
    return name.startswith(f"{SAMPLER}.")
