"""Names of Dr.Jit's and Mitsuba's array types, for annotations; NumPy's memory as kernels read it.

The classes themselves depend on the variant that is set (``llvm_ad_rgb``, ``cuda_ad_rgb``), so they exist
only once Mitsuba is loaded, and type checkers do not know them. Each alias stands for the attribute of
``mitsuba`` of the same name; an array has one entry per lane, a width of 1 serves all lanes.
"""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.generic)

# Largest packet of a kernel, in numbers.
_PACKET = 16

# One number per lane: float32, float64, uint32, int32, bool.
Float: TypeAlias = Any
Float64: TypeAlias = Any
UInt32: TypeAlias = Any
Int32: TypeAlias = Any
Mask: TypeAlias = Any

# Several float32 per lane. Directions and normals are unit vectors unless stated otherwise.
Point2f: TypeAlias = Any
Point3f: TypeAlias = Any
Vector2f: TypeAlias = Any
Vector3f: TypeAlias = Any
Vector4f: TypeAlias = Any
Normal3f: TypeAlias = Any
Frame3f: TypeAlias = Any
Ray3f: TypeAlias = Any

# Linear Rec.709 RGB per lane. In the RGB variants ``mi.Spectrum`` is ``mi.Color3f``.
Color3f: TypeAlias = Any
Spectrum: TypeAlias = Any

# Records with one entry per lane.
SurfaceInteraction3f: TypeAlias = Any
DirectionSample3f: TypeAlias = Any
BSDFSample3f: TypeAlias = Any

# Mitsuba objects, one for all lanes.
Texture: TypeAlias = Any
BSDF: TypeAlias = Any
BSDFContext: TypeAlias = Any
Properties: TypeAlias = Any
Sampler: TypeAlias = Any
Scene: TypeAlias = Any


def padded(numbers: NDArray[Number]) -> NDArray[Number]:
    """A copy with room behind it, C-ordered.

    Dr.Jit does not copy arrays of NumPy, and its kernels read whole packets: up to 15 numbers beyond the end,
    which may be the end of the memory that the process has.
    """
    room = np.empty(numbers.size + _PACKET, numbers.dtype)
    copy = room[: numbers.size].reshape(numbers.shape)
    copy[...] = numbers
    return copy
