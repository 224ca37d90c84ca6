"""Operations, of which models are lists (:mod:`mbtf_fit.ops.operation`). Nothing here needs PyTorch."""

from __future__ import annotations

from mbtf_fit.ops.fibers import FiberFrame
from mbtf_fit.ops.lookup import Displace, Lookup, Neighborhood, Offset, SurfaceMaps, Trace
from mbtf_fit.ops.network import (
    Frequencies,
    HalfVector,
    Inception,
    Network,
    Position,
    Rotate,
    Stereographic,
    ToFrame,
)
from mbtf_fit.ops.operation import Backend, Operation, read_operations, sizes_of, stages
from mbtf_fit.ops.shade import Lobe, Shade
from mbtf_fit.ops.value import Calibrate, DivideByCosine, Gate, Matrix, Product, Standardize, Transform

__all__ = [
    "Backend",
    "Calibrate",
    "Displace",
    "DivideByCosine",
    "FiberFrame",
    "Frequencies",
    "Gate",
    "HalfVector",
    "Inception",
    "Lobe",
    "Lookup",
    "Matrix",
    "Neighborhood",
    "Network",
    "Offset",
    "Operation",
    "Position",
    "Product",
    "Rotate",
    "Shade",
    "Standardize",
    "Stereographic",
    "SurfaceMaps",
    "ToFrame",
    "Trace",
    "Transform",
    "read_operations",
    "sizes_of",
    "stages",
]
