"""Estimators of M under an effects plan: surface, tile and transport, or the closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.engine.runtime import CPU_VARIANT
from mbtf_gen.images.resample import resample
from mbtf_gen.job import Job
from mbtf_gen.planning.effects import EffectsPlan
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.sampling.query_sampler import Queries
from mbtf_gen.tile.heights.slopes import height_slopes, residual_slopes

# Effects that change the tile: its shape or its surface.
_TILE_EFFECTS = frozenset(
    {"parallax", "specular", "metallic", "clearcoat", "sheen", "transmission", "normal", "opacity"}
)


class ClosedForm:
    """M of a plane of one Lambert color: linear albedo (3,)/π at every query, without noise."""

    def __init__(self, albedo: NDArray[np.float64]) -> None:
        self.value = (np.asarray(albedo, np.float64) / np.pi).astype(np.float32)

    def estimate(self, queries: Queries, spp: int | NDArray[np.int64], stream: Stream) -> Estimates:
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
    job : Job
        Configuration and material.
    plan : EffectsPlan
        Effects to simulate.
    tiles : dict, optional
        Tiles of this job built so far, by the effects that change them. Plans that share a dictionary share
        their tiles.
    variant : str
        Variant of Mitsuba, which sets the device; one per process.

    Returns
    -------
    Estimator or ClosedForm

    Raises
    ------
    InputError
        Mitsuba does not accept the material's BSDF.
    EngineError
        Mitsuba or the device cannot be used here.
    """
    if plan.closed_form:
        return ClosedForm(np.asarray(job.material.base_color, np.float64).reshape(-1, 3)[0])
    from mbtf_gen.engine.runtime import load_mitsuba

    load_mitsuba(variant)
    from mbtf_gen.render.bsdf.plugin import bsdf_of
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_tile
    from mbtf_gen.sampling.light_kernel import LightKernel

    tiles = {} if tiles is None else tiles
    key = plan.names_on & _TILE_EFFECTS
    if key not in tiles:
        tiles[key] = build_tile(
            job.material.shape or job.grid,
            bsdf_of(job.material, key, shading_slopes(job, plan)),
            job.config.geometry.tracer,
        )
    transport = Transport(
        plan.max_depth,
        plan.roulette_depth,
        job.config.transport.max_crossings,
        displacement=plan.on("parallax"),
        shadowing=plan.on("shadowing"),
        interreflection=plan.on("interreflection"),
        bsdf_sampling=plan.on("bsdf_sampling"),
    )
    return Estimator(tiles[key], LightKernel(job.config.light.width), transport)


def normal_map_slopes(job: Job) -> tuple[NDArray[np.float64], float] | None:
    """Slopes (h, w, 2) that the normal map adds to the mesh, and the share of the mesh's own slopes that the
    map repeats; None without a map or where the options switch it off."""
    material, mode = job.material, job.config.effects.normal
    if material.normal is None or material.bsdf is not None or mode == "off":
        return None
    return residual_slopes(material.normal, job.grid, mode)


def shading_slopes(job: Job, plan: EffectsPlan) -> NDArray[np.float64] | None:
    """Slopes (h, w, 2) that shading adds to the geometry's: those of the normal map, and those of the heights
    where they are not displaced."""
    mapped = normal_map_slopes(job) if plan.on("normal") else None
    residual = None if mapped is None else mapped[0]
    if plan.on("parallax") or job.displacement_range == 0.0:
        return residual
    slopes = height_slopes(job.grid)
    if residual is None:
        return slopes
    return residual + np.asarray(resample(slopes, *residual.shape[:2]), np.float64)
