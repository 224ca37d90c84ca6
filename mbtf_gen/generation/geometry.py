"""The geometry of a job's surface, without the effects that its plan leaves out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.geometry import FINEST_LEVEL, GLOSSY, Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_core.images.resample import resample
from mbtf_gen.job import Job
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.simulation import shading_slopes
from mbtf_gen.tile.heights.slopes import height_slopes

F32 = NDArray[np.float32]


def geometry_of(job: Job, plan: EffectsPlan) -> Geometry | None:
    """Geometry of a job's surface, without the effects that its plan leaves out.

    Parameters
    ----------
    job : Job
        Configuration and material.
    plan : EffectsPlan
        Effects that are simulated.

    Returns
    -------
    Geometry or None
        None for fibers, which have neither heights nor slopes.
    """
    material, grid = job.material, job.material.grid
    if grid is None:
        return None
    shape = Lattice(min(job.lattice.finest + 1, FINEST_LEVEL), grid.aspect).shape()
    x, y = np.moveaxis(_slopes(job, plan), -1, 0)
    geometry = Geometry(
        grid.z.astype(np.float32),
        grid.aspect,
        np.stack([_means(s, shape) for s in (x, y)], axis=-1),
        np.stack([_means(a * b, shape) for a, b in ((x, x), (x, y), (y, y))], axis=-1),
    )
    if material.bsdf_type is not None:
        return geometry
    maps: dict[str, Any] = {"base_color": _means(material.base_color, shape)}
    if plan.on("specular") or plan.on("metallic"):
        weights = {name: material.maps[name] if plan.on(name) else 0.0 for name in GLOSSY[1:]}
        shares = {"roughness": material.maps["roughness"], **weights}
        maps |= {name: _means(share, shape) for name, share in shares.items()}
    if "opacity" in material.maps and plan.on("opacity"):
        maps["opacity"] = _means(material.maps["opacity"], shape)
    return replace(geometry, **maps)


def _slopes(job: Job, plan: EffectsPlan) -> NDArray[np.float64]:
    """Slopes (h, w, 2) of the shading normal, at the finest resolution of those that add up."""
    added = shading_slopes(job, plan)
    grid = job.material.grid
    mesh = height_slopes(grid) if grid is not None and plan.on("parallax") else None
    terms = [slopes for slopes in (added, mesh) if slopes is not None]
    if not terms:
        return np.zeros((1, 1, 2))
    rows, columns = (max(slopes.shape[axis] for slopes in terms) for axis in (0, 1))
    return np.asarray(sum(resample(slopes, rows, columns) for slopes in terms), np.float64)


def _means(values: ArrayLike | None, shape: tuple[int, int]) -> F32:
    """Means over the texels (h, w) of a map (H, W, ...) or of a constant."""
    array = np.asarray(values, np.float64)
    if array.ndim < 2:
        return np.broadcast_to(array, (*shape, *array.shape)).astype(np.float32)
    return resample(array, *shape).astype(np.float32)
