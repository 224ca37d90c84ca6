"""Type aliases of Dr.Jit's and Mitsuba's arrays, whose classes depend on the variant that is set.

All are arrays of one element per lane. They are ``Any`` to the type checker, and name what a parameter holds.
"""

from __future__ import annotations

from typing import Any, TypeAlias

# Single-precision numbers, signed and unsigned integers, booleans.
Float: TypeAlias = Any
Int32: TypeAlias = Any
UInt32: TypeAlias = Any
Mask: TypeAlias = Any
# Vectors of single-precision numbers; RGB colors and spectra.
Point2f: TypeAlias = Any
Point3f: TypeAlias = Any
Vector2f: TypeAlias = Any
Vector3f: TypeAlias = Any
Color3f: TypeAlias = Any
Spectrum: TypeAlias = Any
# Records of Mitsuba.
Ray3f: TypeAlias = Any
SurfaceInteraction3f: TypeAlias = Any
DirectionSample3f: TypeAlias = Any
BSDFSample3f: TypeAlias = Any
# Objects of Mitsuba, one for all lanes.
BSDF: TypeAlias = Any
BSDFContext: TypeAlias = Any
Properties: TypeAlias = Any
Sampler: TypeAlias = Any
Scene: TypeAlias = Any
