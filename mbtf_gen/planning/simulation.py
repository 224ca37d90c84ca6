"""Estimators of M under an effects plan: surface, tile and transport, or the closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.data.queries import Queries
from mbtf_core.images.resample import resample
from mbtf_gen.engine.runtime import CPU_VARIANT
from mbtf_gen.job import Job
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import EffectsPlan
from mbtf_gen.render.estimates import Estimates, Stream
from mbtf_gen.tile.heights.slopes import height_slopes


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
    from mbtf_gen.render.estimator import Estimator
    from mbtf_gen.render.path_tracer import Transport
    from mbtf_gen.render.scene import build_scene
    from mbtf_gen.sampling.light_kernel import LightKernel

    tiles = {} if tiles is None else tiles
    key = frozenset(name for name in plan.names_on if EFFECTS[name].alters_tile)
    if key not in tiles:
        tiles[key] = build_scene(job.material, job.material.surface(key, shading_slopes(job, plan)))
    transport = Transport(
        plan.max_depth,
        plan.roulette_depth,
        job.config.transport.max_crossings,
        **{effect.switch: plan.on(name) for name, effect in EFFECTS.items() if effect.switch},
    )
    return Estimator(tiles[key], LightKernel(job.config.light.width), transport)


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
