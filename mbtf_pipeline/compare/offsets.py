"""Parallax offsets: the lateral displacement between the reference plane and the visible surface.

The view ray through the point u of the reference plane continues below the plane and hits the surface at
height z < 0, displaced laterally by ``z · ω_o.xy / ω_o.z``. Models with a learned offset shift their lookup
in a similar way. Their training does not enforce equality, so learned and traced offsets are shown side by
side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.lattice import Lattice, texel_centers
from mbtf_core.directions import from_angles
from mbtf_pipeline.compare.image_files import read_channels, write_channels
from mbtf_pipeline.recipe import SceneView

if TYPE_CHECKING:
    from mbtf_fit import Material
    from mbtf_gen.render.estimator import Estimator

F32 = NDArray[np.float32]
OFFSETS = "offsets"
# Largest number of texels across an offset image.
_MAX_RESOLUTION = 256


def traced_offset(estimator: Estimator, u: F32, omega_o: NDArray[np.float64]) -> F32:
    """Lateral displacement (n, 2) in tile widths of the surface seen through points (n, 2), uv, of the
    reference plane, in a view direction (3,)."""
    import drjit as dr
    import mitsuba as mi

    from mbtf_gen.render.scene import CLEARANCE, ray_through

    tile = estimator.tile
    towards = mi.Vector3f([float(c) for c in omega_o])
    point = mi.Point2f(np.ascontiguousarray(u.T, np.float32))
    ray = ray_through(point, dr.repeat(towards, len(u)), tile.unit, tile.aspect, CLEARANCE)
    hit, *_ = tile.geometry.closest_hit(ray, mi.Bool(True), estimator.transport.max_crossings)
    z = np.array(dr.select(hit.is_valid(), hit.p.z, 0.0)) / tile.unit
    return (z[:, None] * omega_o[None, :2] / omega_o[2]).astype(np.float32)


def read_offset(path: Path) -> F32:
    """Displacements (rows, columns, 2) in tile widths; errors are those of :func:`read_channels`."""
    return read_channels(path, "XY")


def towards_view(offset: F32, view: SceneView) -> F32:
    """Component of displacements (..., 2) towards the viewer's azimuth, in tile widths."""
    along: F32 = (offset @ from_angles(0.0, view.azimuth)[:2]).astype(np.float32)
    return along


def _correlation(x: F32, y: F32) -> float | None:
    """Pearson's r; None where it is undefined."""
    a, b = (v.astype(np.float64).ravel() - v.mean(dtype=np.float64) for v in (x, y))
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 1e-20 else None


def write_offsets(
    estimator: Estimator,
    materials: Mapping[str, Material],
    views: Sequence[SceneView],
    lattice: Lattice,
    out: Path,
) -> list[dict[str, Any]]:
    """Write traced and learned offsets of every view below `out`; returns plain data about them, such as the
    correlation of learned ones with the traced one. Models without an offset are left out."""
    level = min(lattice.finest, int(np.log2(_MAX_RESOLUTION)))
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
        write_channels(out / file, truth.reshape(rows, columns, 2), "XY")
        along = towards_view(truth, view)
        record: dict[str, Any] = {"view": view.model_dump(), "traced": file, "fits": {}}
        for name, offsets in learned.items():
            offset = offsets[number - 1]
            file = f"{OFFSETS}/v{number}-fit-{name}.exr"
            write_channels(out / file, offset.reshape(rows, columns, 2), "XY")
            found = _correlation(along, towards_view(offset, view))
            record["fits"][name] = {"file": file, "correlation": found}
        records.append(record)
    return records
