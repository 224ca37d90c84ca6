"""Offsets: how far from a point of the reference plane a view sees the surface, learned and traced.

The ray against ω_o through the plane's point u goes on below the plane and meets the surface at height z < 0,
displaced sideways by ``z · ω_o.xy / ω_o.z``. Models with a learned offset move their lookup by something of
that kind; nothing forces them to find the same, so the two are shown side by side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.atomic import write_through
from mbtf_core.directions import from_angles
from mbtf_core.lattice import Lattice, texel_centers
from mbtf_pipeline.compare.pictures import fit_name
from mbtf_pipeline.recipe import View

if TYPE_CHECKING:
    from mbtf_fit import Material
    from mbtf_gen.render.estimator import Estimator

F32 = NDArray[np.float32]
OFFSETS = "offsets"
# Texels across, at most, of an offset picture.
_LARGEST = 256


def traced_offset(estimator: Estimator, u: F32, omega_o: NDArray[np.float64]) -> F32:
    """Sideways displacement (n, 2) in tile widths of what a view sees through points of the reference plane.

    Parameters
    ----------
    u : (n, 2) uv; omega_o : (3,) view direction
    """
    import drjit as dr
    import mitsuba as mi

    from mbtf_gen.render.heightfield_tracer import closest_hit
    from mbtf_gen.render.scene import CLEARANCE
    from mbtf_gen.render.sensor import ray_through

    tile = estimator.tile
    towards = mi.Vector3f([float(c) for c in omega_o])
    point = mi.Point2f(np.ascontiguousarray(u.T, np.float32))
    ray = ray_through(point, dr.repeat(towards, len(u)), tile.unit, tile.aspect, CLEARANCE)
    hit, *_ = closest_hit(tile.world.heightfield, ray, mi.Bool(True), estimator.transport.max_crossings)
    z = np.array(dr.select(hit.is_valid(), hit.p.z, 0.0)) / tile.unit
    return (z[:, None] * omega_o[None, :2] / omega_o[2]).astype(np.float32)


def _write(path: Path, offset: F32) -> None:
    """Store (rows, columns, 2) as the channels X and Y of an EXR image."""
    import OpenEXR

    channels = {name: np.ascontiguousarray(offset[..., i]) for i, name in enumerate("XY")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    write_through(path, lambda p: OpenEXR.File(header, channels).write(str(p)))


def read_offset(path: Path) -> F32:
    """Displacements (rows, columns, 2) in tile widths.

    Raises
    ------
    InputError : missing or damaged
    """
    from mbtf_gen.images.exr import read_channels

    channels = read_channels(path, 1 << 26)
    return np.stack([channels["X"], channels["Y"]], axis=-1).astype(np.float32)


def towards_view(offset: F32, view: View) -> F32:
    """Component of displacements (..., 2) towards the viewer's azimuth, in tile widths."""
    along = from_angles(0.0, view.azimuth)[:2]
    out: F32 = (offset @ along).astype(np.float32)
    return out


def _correlation(x: F32, y: F32) -> float | None:
    """Pearson's r of two arrays; None where one of them is constant."""
    a, b = (v.astype(np.float64).ravel() - v.mean(dtype=np.float64) for v in (x, y))
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 1e-20 else None


def _slope(x: F32, y: F32) -> float | None:
    """Slope of the line through y over x, both less their means; None where x is constant."""
    a, b = (v.astype(np.float64).ravel() - v.mean(dtype=np.float64) for v in (x, y))
    square = float(a @ a)
    return float(a @ b) / square if square > 1e-20 else None


def write_offsets(
    estimator: Estimator,
    materials: Mapping[str, Material],
    views: Sequence[View],
    lattice: Lattice,
    out: Path,
) -> list[dict[str, Any]]:
    """Write traced and learned offsets of every view below `out`; plain data about them.

    Of displacements towards the viewer ``spread`` is the standard deviation over the tile in tile widths; of
    learned ones ``correlation`` is that with the traced, and ``slope`` that of the line through them over the
    traced, which is 1 for the same size.

    Models that move nothing are left out; without any that does, nothing is written.
    """
    level = min(lattice.finest, int(np.log2(_LARGEST)))
    rows, columns = lattice.shape(level)
    u = texel_centers(rows, columns).reshape(-1, 2).astype(np.float32)
    directions = [from_angles(view.elevation, view.azimuth) for view in views]
    learned: dict[str, list[F32]] = {}
    for name, material in materials.items():
        repeated = (np.broadcast_to(d.astype(np.float32), (len(u), 3)).copy() for d in directions)
        offsets = [np.asarray(material.offset(u, d), np.float32) for d in repeated]
        if any(offset.any() for offset in offsets):
            learned[name] = offsets
    if not learned:
        return []
    (out / OFFSETS).mkdir(parents=True, exist_ok=True)
    records = []
    for number, (view, direction) in enumerate(zip(views, directions, strict=True), 1):
        truth = traced_offset(estimator, u, direction)
        file = f"{OFFSETS}/v{number}-traced.exr"
        _write(out / file, truth.reshape(rows, columns, 2))
        along = towards_view(truth, view)
        record: dict[str, Any] = {"view": view.model_dump(), "traced": file, "fits": {}}
        record["spread"] = float(along.std(dtype=np.float64))
        for name, offsets in learned.items():
            offset = offsets[number - 1]
            file = f"{OFFSETS}/v{number}-{fit_name(name)}.exr"
            _write(out / file, offset.reshape(rows, columns, 2))
            moved = towards_view(offset, view)
            record["fits"][name] = {
                "file": file,
                "correlation": _correlation(moved, along),
                "slope": _slope(along, moved),
                "spread": float(moved.std(dtype=np.float64)),
            }
        records.append(record)
    return records
