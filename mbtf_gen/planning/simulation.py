"""What a run simulates under an effects plan: the estimator of M, or its closed form, and the geometry."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbtf_core.data.geometry import CLEARCOAT, FINEST_LEVEL, GLOSSY, Geometry
from mbtf_core.data.lattice import Lattice
from mbtf_core.data.schema import Queries
from mbtf_core.images.resample import resample
from mbtf_gen.engine.runtime import CPU_VARIANT, load_mitsuba
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.planning.job import Job
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heights import height_slopes


class ClosedForm:
    """M of a plane of one Lambert color: linear albedo (3,)/π at every query, without noise."""

    def __init__(self, albedo: NDArray[np.float64]) -> None:
        self.value = (np.asarray(albedo, np.float64) / np.pi).astype(np.float32)

    def estimate(
        self, queries: Queries, spp: int | NDArray[np.int64], stream: Stream, *, lights: int = 1
    ) -> Estimates:
        """Both halves of each query (one leading axis), equal."""
        value = np.broadcast_to(self.value, (len(queries.sigma), 3))
        return Estimates(value.copy(), value.copy(), None, 0, 0, 0, 0)


def build_estimator(
    job: Job,
    plan: EffectsPlan,
    tiles: dict[frozenset[str], Any] | None = None,
    variant: str = CPU_VARIANT,
) -> Any:
    """Estimator of M for a job's material under an effects plan; loads Mitsuba unless M has a closed form.

    Parameters
    ----------
    tiles : tiles of this job built so far, by the effects that change them; plans that share a dictionary
        share their tiles
    variant : of Mitsuba, which sets the device; one per process

    Raises
    ------
    InputError : Mitsuba does not accept the material's BSDF
    EngineError : Mitsuba or the device cannot be used here
    """
    if plan.closed_form:
        return ClosedForm(np.asarray(job.material.base_color, np.float64).reshape(-1, 3)[0])
    load_mitsuba(variant)
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel

    tiles = {} if tiles is None else tiles
    key = _of_tile(plan)
    if key not in tiles:
        tiles[key] = build_scene(job.material, job.material.surface(key, shading_slopes(job, plan)))
    transport = Transport(
        plan.max_depth,
        plan.roulette_depth,
        job.config.transport.max_crossings,
        **{effect.switch: plan.on(name) for name, effect in EFFECTS.items() if effect.switch},
    )
    return Estimator(tiles[key], LightKernel(job.config.light.width), transport)


def _of_tile(plan: EffectsPlan) -> frozenset[str]:
    """Names of the effects that are on and change the tile."""
    return frozenset(name for name in plan.names_on if EFFECTS[name].alters_tile)


def pilot_queries(job: Job, count: int, shard: int = 0, lights: int = 1) -> Queries:
    """`count` queries (one leading axis) with the run's distribution, from a random stream of their own per
    `shard`.

    In both layouts every query has its own footprint and directions: a few images would have few of them.
    With several `lights`, groups of so many queries share footprint and view.
    """
    plan = replace(job.query_plan, layout="shuffled", patch_size=None, lights=lights)
    return plan.draw("pilot", shard, count)


def shading_slopes(job: Job, plan: EffectsPlan) -> NDArray[np.float64] | None:
    """Slopes (h, w, 2) that shading adds to the geometry's: those of the normal map, and those of the heights
    where they are not displaced."""
    tile = job.material
    mapped = tile.normal_slopes(job.config.effects.normal) if plan.on("normal") else None
    residual = None if mapped is None else mapped[0]
    if plan.on("parallax") or tile.grid is None or tile.thickness == 0.0:
        return residual
    slopes = height_slopes(tile.grid)
    if residual is None:
        return slopes
    return residual + np.asarray(resample(slopes, *residual.shape[:2]), np.float64)


def geometry_of(job: Job, plan: EffectsPlan) -> Geometry:
    """Geometry of a job's surface, without the effects that its plan leaves out."""
    material, grid = job.material, job.material.grid
    if grid is None:
        load_mitsuba()
        from mbtf_gen.render.envelope import seen_from_above

        return seen_from_above(material, job.lattice.finest, _of_tile(plan))
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
    if plan.on("clearcoat"):
        maps |= {name: _means(material.maps[name], shape) for name in CLEARCOAT}
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


def _means(values: ArrayLike | None, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Means over the texels (h, w) of a map (H, W, ...) or of a constant."""
    array = np.asarray(values, np.float64)
    if array.ndim < 2:
        return np.broadcast_to(array, (*shape, *array.shape)).astype(np.float32)
    return resample(array, *shape).astype(np.float32)
