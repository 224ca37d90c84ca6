"""NumPy's memory as kernels read it."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.generic)

# Largest packet of a kernel, in numbers.
_PACKET = 16


def padded(numbers: NDArray[Number]) -> NDArray[Number]:
    """A copy with room behind it, C-ordered.

    Dr.Jit does not copy arrays of NumPy, and its kernels read whole packets: up to 15 numbers beyond the end,
    which may be the end of the memory that the process has.
    """
    room = np.empty(numbers.size + _PACKET, numbers.dtype)
    copy = room[: numbers.size].reshape(numbers.shape)
    copy[...] = numbers
    return copy
