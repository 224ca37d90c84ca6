"""Values as operations read them: parts, shapes, and as many rows each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mbtf_fit.ops.operation import parse


def read_value(values: Mapping[str, Tensor], name: str, part: slice) -> Tensor:
    """Some numbers of a value; all of them as they are."""
    return values[name] if part == slice(None) or values[name].ndim == 1 else values[name][:, part]


def read_values(values: Mapping[str, Tensor], references: Sequence[str]) -> Tensor:
    """Values (n, numbers), concatenated."""
    found = (shaped("x", read_value(values, *parse(reference))) for reference in references)
    return torch.cat([x for x in found if isinstance(x, Tensor)], 1)


def shaped(field: str, argument: Tensor | list[Tensor] | None) -> object:
    """What a field reads, with the shapes of :mod:`mbtf_fit.pytorch.operations`."""
    if isinstance(argument, list):
        return [shaped(field, item) for item in argument]
    if argument is None or (argument.ndim == 1) == (field == "level"):
        return argument
    return argument[:, 0] if field == "level" else argument[:, None]


def aligned(arguments: list[object]) -> list[object]:
    """The same with as many rows each: those of queries are repeated for their positions."""
    tensors = [t for a in arguments for t in (a if isinstance(a, list) else [a]) if isinstance(t, Tensor)]
    rows = max(map(len, tensors))
    if all(len(t) == rows for t in tensors):
        return arguments

    def repeated(argument: object) -> object:
        if isinstance(argument, list):
            return [repeated(item) for item in argument]
        if isinstance(argument, Tensor) and len(argument) < rows:
            return argument.repeat_interleave(rows // len(argument), 0)
        return argument

    return [repeated(argument) for argument in arguments]
