"""From an effects plan to what evaluates it: surface, tile, transport — or the closed form."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.geometry.slopes import height_slopes
from mbtf_gen.images.resample import resample
from mbtf_gen.planning.effects import EffectsPlan
from mbtf_gen.render.estimates import Estimates, Stream

if TYPE_CHECKING:
    from mbtf_gen.generation import Job
    from mbtf_gen.sampling.query_sampler import Queries


class MeanEstimator(Protocol):
    """Estimates M at queries."""

    def estimate(self, queries: Queries, spp: int | NDArray[np.int64], stream: Stream) -> Estimates:
        """Both halves of each query; paths of all or of each."""


class ClosedForm:
    """M of a plane of one Lambert color, ``albedo/π`` at every query: nothing to trace, and no noise.

    Parameters
    ----------
    albedo : (3,) linear
    """

    def __init__(self, albedo: NDArray[np.float64]) -> None:
        self.value = (np.asarray(albedo, np.float64) / np.pi).astype(np.float32)

    def estimate(self, queries: Queries, spp: int | NDArray[np.int64], stream: Stream) -> Estimates:
        """Both halves of each query (one leading axis), equal."""
        value = np.broadcast_to(self.value, (len(queries.sigma), 3))
        return Estimates(value.copy(), value.copy(), None, 0, 0, 0, 0)


def estimator_of(job: Job, plan: EffectsPlan, tiles: dict[Any, Any]) -> Any:
    """Estimator of a job's material under a plan; `tiles` keeps meshes that several plans share."""
    if plan.closed_form:
        base = np.asarray(job.material.base_color, np.float64).reshape(-1, 3)[0]
        return ClosedForm(base)
    from mbtf_gen.render.runtime import load_mitsuba

    load_mitsuba()
    from mbtf_gen.render.bsdf.plugin import bsdf_of
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_tile
    from mbtf_gen.sampling.light_kernel import LightKernel

    of_surface = ("specular", "metallic", "coat", "sheen", "normal", "opacity")
    parts = tuple(plan.on(n) for n in ("masking", *of_surface))
    if parts not in tiles:
        tiles[parts] = build_tile(job.grid, bsdf_of(job.material, plan, _slopes(job, plan)))
    config = job.config
    transport = Transport(
        plan.max_depth,
        plan.roulette_depth,
        config.transport.max_crossings,
        displacement=plan.on("masking"),
        shadowing=plan.on("shadowing"),
        interreflection=plan.on("interreflection"),
        bsdf_sampling=plan.on("mis"),
    )
    return Estimator(tiles[parts], LightKernel(config.light.width), transport)


def _slopes(job: Job, plan: EffectsPlan) -> NDArray[np.float64] | None:
    """Slopes (h, w, 2) that shading adds to the geometry's: the residual of the normal map, and the relief's
    own where it is not displaced."""
    residual = job.residual[0] if job.residual is not None and plan.on("normal") else None
    if plan.on("masking") or job.grid.displacement_range == 0.0:
        return residual
    relief = height_slopes(job.grid)
    if residual is None:
        return relief
    return residual + np.asarray(resample(relief, *residual.shape[:2]), np.float64)
