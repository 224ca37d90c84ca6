"""Names of Dr.Jit's and Mitsuba's array types, for annotations alone.

The classes themselves depend on the variant that is set (``llvm_ad_rgb``, ``cuda_ad_rgb``), so they exist
only once Mitsuba is loaded, and type checkers do not know them. Each alias stands for the attribute of
``mitsuba`` of the same name; an array has one entry per lane, a width of 1 serves all lanes.
"""

from __future__ import annotations

from typing import Any, TypeAlias

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
