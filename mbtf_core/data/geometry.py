"""``geometry.exr``: what a data set tells about its surface, beside the shards.

The heights are those of the mesh. The maps have the texels of one level more than the data, at most those of
level 11, and each texel is a mean over its area. A mean slope alone loses the detail below a texel. The means
of the slopes' products keep its variance: Σ = E[s sᵀ] - E[s] E[s]ᵀ, at the resolution of the maps and at any
coarser one (LEAN mapping, Olano and Baker 2010). The products are computed at the finer of the resolutions of
mesh and normal map, before any averaging.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import GEOMETRY, GEOMETRY_NAME, ArraySpec
from mbtf_core.errors import InputError

F32 = NDArray[np.float32]

# Finest level whose texels the maps have.
FINEST_LEVEL = 11
# Parts of the file: the resolution of the mesh, and that of the maps.
HEIGHTS, MAPS = "heights", "maps"
_ASPECT = "mbtf.aspect"
# Attributes of Geometry whose channels have other names.
_ATTRIBUTES = {
    "height": "heights",
    "slope": "slopes",
    "slope_moment": "slope_moments",
    "tangent_moment": "tangent_moments",
}
# Of each group all or none are stored.
GLOSSY = ("roughness", "metallic", "specular")
CLEARCOAT = ("clearcoat", "clearcoat_roughness")
FIBERS = ("tangent_moments", "longitudinal_variance")
# Components that are means of squares.
_SQUARES: dict[str, Any] = {
    "slope_moment": (0, 2),
    "tangent_moment": (0, 3, 5),
    "longitudinal_variance": None,
}


@dataclass(frozen=True)
class Geometry:
    """Heights, slopes and reflectance of a tile, as they were simulated. Row 0 is the side ``v → 1``.

    Attributes
    ----------
    heights : (H, W) float32 array
        Heights ≤ 0 of the mesh in tile widths, maximum 0; vertices lie on texel centers.
    aspect : height of the tile over its width
    slopes : (h, w, 2) float32 array
        Means of the slopes ``s = (dz/dx, dz/dy)`` of the shading normal over each texel.
    slope_moments : (h, w, 3) float32 array
        Means of ``sx²``, ``sx·sy`` and ``sy²`` over each texel.
    base_color : (h, w, 3) float32 array or None
        Linear Rec.709 in [0, 1]; None where the material has its own BSDF.
    roughness, metallic, specular : (h, w) float32 array or None
        In [0, 1]; all three are None for a Lambert surface, or where the material has its own BSDF.
    opacity : (h, w) float32 array or None
        In [0, 1]; None for an opaque surface.
    clearcoat, clearcoat_roughness : (h, w) float32 array or None
        In [0, 1], weight and roughness of the coat; both are None for a surface without.
    tangent_moments, longitudinal_variance : (h, w, 6) and (h, w) float32 arrays or None
        Of the fibers seen from above: means of the products ``xx, xy, xz, yy, yz, zz`` of their directions,
        and of the variance of their lobe in square radians, 0 in gaps; None where there are no fibers.
    """

    heights: F32
    aspect: float
    slopes: F32
    slope_moments: F32
    base_color: F32 | None = None
    roughness: F32 | None = None
    metallic: F32 | None = None
    specular: F32 | None = None
    opacity: F32 | None = None
    clearcoat: F32 | None = None
    clearcoat_roughness: F32 | None = None
    tangent_moments: F32 | None = None
    longitudinal_variance: F32 | None = None

    @classmethod
    def of_heights(cls, heights: F32, aspect: float) -> Geometry:
        """Geometry of heights (H, W) alone, without detail below a texel: slopes are those of the mesh."""
        slopes = mesh_slopes(heights.astype(np.float64), aspect).astype(np.float32)
        x, y = np.moveaxis(slopes, -1, 0)
        return cls(heights, aspect, slopes, np.stack([x * x, x * y, y * y], axis=-1))


def mesh_slopes(z: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    """Slopes (H, W, 2) of a mesh of heights (H, W) at its vertices, by central differences over the period.

    Parameters
    ----------
    z : heights in tile widths; row 0 is the side ``v → 1``
    aspect : height of the tile over its width
    """
    rows, columns = z.shape
    along_x = (np.roll(z, -1, 1) - np.roll(z, 1, 1)) * (0.5 * columns)
    along_y = (np.roll(z, 1, 0) - np.roll(z, -1, 0)) * (0.5 * rows / aspect)
    return np.stack([along_x, along_y], axis=-1)


def encode_geometry(geometry: Geometry) -> bytes:
    """The bytes of ``geometry.exr``, which depend on the geometry alone.

    Parameters
    ----------
    geometry : Geometry

    Returns
    -------
    bytes
        An uncompressed EXR file of two parts, ``heights`` and ``maps``.

    Raises
    ------
    PartialError : the folder for temporary files cannot be written
    """
    from mbtf_core.images.exr import encode_parts

    parts: dict[str, dict[str, F32]] = {HEIGHTS: {}, MAPS: {}}
    for spec in _present(geometry):
        array = np.asarray(getattr(geometry, _attribute(spec)), np.float32)
        part = parts[HEIGHTS if spec.name == "height" else MAPS]
        for index, channel in enumerate(spec.channels):
            part[channel] = np.ascontiguousarray(array[..., index] if spec.trailing else array)
    # As text: EXR files have no float64 attributes that every reader knows.
    return encode_parts(parts, {_ASPECT: repr(float(geometry.aspect))})


def geometry_record(geometry: Geometry) -> dict[str, Any]:
    """The manifest's key ``geometry``: file, digest, channels and shapes."""
    return {
        "file": GEOMETRY_NAME,
        "sha256": hashlib.sha256(encode_geometry(geometry)).hexdigest(),
        "channels": {
            channel: {"unit": spec.unit, "meaning": spec.meaning}
            for spec in _present(geometry)
            for channel in spec.channels
        },
        "heights_shape": list(geometry.heights.shape),
        "maps_shape": list(geometry.slopes.shape[:2]),
    }


def _attribute(spec: ArraySpec) -> str:
    return _ATTRIBUTES.get(spec.name, spec.name)


def _present(geometry: Geometry) -> Iterable[ArraySpec]:
    return (spec for spec in GEOMETRY if getattr(geometry, _attribute(spec)) is not None)


def read_geometry(path: Path) -> Geometry:
    """Read ``geometry.exr`` and check all of its numbers.

    Parameters
    ----------
    path : the file

    Raises
    ------
    InputError : it is missing, damaged, or no geometry: channels, shapes or numbers are not those of
        :class:`Geometry`
    """
    from mbtf_core.images.exr import read_parts

    if not path.exists():
        raise InputError("no such file", where=path)
    # The file is uncompressed: one that states more pixels than it has bytes is corrupt.
    parts = read_parts(path, max(1, path.stat().st_size))
    if set(parts) != {HEIGHTS, MAPS}:
        raise InputError(f"is no geometry: it has no parts '{HEIGHTS}' and '{MAPS}'", where=path)
    aspect = _aspect(parts[HEIGHTS][0].get(_ASPECT), path)
    found = {**parts[HEIGHTS][1], **parts[MAPS][1]}
    arrays: dict[str, F32] = {}
    for spec in GEOMETRY:
        missing = [channel for channel in spec.channels if channel not in found]
        if missing and not (spec.optional and len(missing) == len(spec.channels)):
            raise InputError(f"has no channel '{missing[0]}'", where=path)
        if not missing:
            channels = [np.asarray(found.pop(channel), np.float32) for channel in spec.channels]
            arrays[_attribute(spec)] = np.stack(channels, axis=-1) if spec.trailing else channels[0]
    if found:
        raise InputError(f"has an unknown channel '{min(found)}'", where=path)
    geometry = Geometry(aspect=aspect, **arrays)
    _check(geometry, path)
    return geometry


def _aspect(text: object, path: Path) -> float:
    try:
        aspect = float(str(text))
    except ValueError:
        aspect = math.nan
    if not 0 < aspect < math.inf:
        raise InputError(f"is no geometry: '{_ASPECT}' in its header is {text!r}", where=path)
    return aspect


def _check(geometry: Geometry, path: Path) -> None:
    """An InputError where shapes or numbers cannot be those of a tile."""
    rows, columns = geometry.slopes.shape[:2]
    level = columns.bit_length() - 1
    if level > FINEST_LEVEL or Lattice(level, geometry.aspect).shape() != (rows, columns):
        raise InputError(f"its maps have {columns} x {rows} texels, which no level has", where=path)
    for spec in _present(geometry):
        array, name = getattr(geometry, _attribute(spec)), spec.name
        if name != "height" and array.shape[:2] != (rows, columns):
            raise InputError(f"'{name}' has another size than 'slope'", where=path)
        if not np.isfinite(array).all():
            raise InputError(f"'{name}' holds NaN or infinite numbers", where=path)
        if name in _SQUARES and array[..., _SQUARES[name]].min() < 0:
            raise InputError(f"'{name}' holds negative means of squares", where=path)
        if spec.unit == "1" and not (array.min() >= 0 and array.max() <= 1):
            raise InputError(f"'{name}' holds numbers outside [0, 1]", where=path)
    if geometry.heights.max() != 0:
        raise InputError("the maximum of 'height' is not 0", where=path)
    for group in (GLOSSY, CLEARCOAT, FIBERS):
        if len({getattr(geometry, name) is None for name in group}) > 1:
            raise InputError(f"has some, but not all, of {', '.join(group)}", where=path)
