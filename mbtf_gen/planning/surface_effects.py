"""Facts about a job, and the decisions on its normal map, holes, fibers and sampling of light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mbtf_gen.images.resample import resample
from mbtf_gen.job import Job
from mbtf_gen.planning.bounds import DisplacementBounds
from mbtf_gen.planning.effects import Effect
from mbtf_gen.planning.simulation import normal_map_slopes
from mbtf_gen.tile.fiber_tile import FiberTile
from mbtf_gen.tile.heights.statistics import triangle_slopes
from mbtf_gen.tile.mesh_tile import MeshTile

# Next-event estimation alone has no more variance than both techniques if the narrowest lobe of the surface,
# about 2α wide, is at least this many times wider than the light's.
WIDER = 4.0


@dataclass(frozen=True)
class Analysis:
    """Facts about a job that the decisions need."""

    job: Job
    albedo: NDArray[np.float64]
    lambert: bool
    own_bsdf: bool
    pilots: bool

    @cached_property
    def steepest(self) -> float:
        """Largest slope of any triangle of the mesh (tangent of its angle to the plane)."""
        if self.shape is not None:
            return math.inf
        return float(triangle_slopes(self.job.grid).max())

    @cached_property
    def mapped(self) -> tuple[NDArray[np.float64], float] | None:
        """Slopes that the normal map adds, and the share of the mesh's slopes that it repeats."""
        return normal_map_slopes(self.job)

    @property
    def flat(self) -> bool:
        """Whether nothing is displaced."""
        return self.job.displacement_range == 0.0

    @property
    def shape(self) -> FiberTile | MeshTile | None:
        """Fibers or triangles in place of heights."""
        return self.job.material.shape

    @property
    def kind(self) -> str:
        """The surface, in a word."""
        if self.shape is None:
            return "displaced"
        return "fibers" if isinstance(self.shape, FiberTile) else "mesh"


def analyze(job: Job, pilots: bool) -> Analysis:
    """Facts about a job; `pilots`: whether the decisions may run pilots."""
    material = job.material
    base = np.asarray(material.base_color, np.float64)
    own = material.bsdf is not None
    albedo = np.ones((1, 1, 3)) if own else base.reshape(*(base.shape[:-1] or (1, 1)), 3)
    return Analysis(
        job,
        albedo,
        material.is_lambert and material.clearcoat is None and material.sheen is None,
        own,
        pilots,
    )


def transmission(scene: Analysis) -> Effect:
    """Light that passes through fibers."""
    if not isinstance(scene.shape, FiberTile):
        return Effect("transmission", False, "no fibers", 0.0, present=False)
    return Effect("transmission", True, "light passes through fibers")


def normal_map(scene: Analysis, bounds: DisplacementBounds | None) -> Effect:
    """Slopes that the mesh lacks; `bounds` of a Lambert surface."""
    job = scene.job
    if scene.mapped is None:
        text = "no map" if job.material.normal is None else "off in the configuration"
        text = "the material has its own BSDF" if scene.own_bsdf else text
        return Effect("normal", False, text, 0.0, present=False)
    slopes, share = scene.mapped
    rms = float(np.sqrt(np.mean(np.sum(slopes**2, axis=-1))))
    text = f"adds slopes of {np.degrees(np.arctan(rms)):.2g}° (RMS)"
    if job.config.effects.normal == "residual" and not scene.flat:
        text += f"; {100.0 * share:.0f} % of the mesh's slopes are also in the map and are counted once"
    if rms == 0.0:
        return Effect("normal", False, text, 0.0)
    return Effect("normal", True, text, bounds.normal if bounds else None, "pilot")


def opacity(scene: Analysis, bounds: DisplacementBounds | None) -> Effect:
    """Holes; `bounds` of a Lambert surface."""
    if scene.shape is not None:
        return Effect("opacity", True, f"rays can pass through the {scene.kind}", present=False)
    through = passing(scene)
    if through is None:
        opacity = scene.job.material.opacity
        text = "no map" if opacity is None else "own BSDF" if scene.own_bsdf else "opaque everywhere"
        return Effect("opacity", False, text, 0.0, present=False)
    text = f"{100.0 * through.mean():.2g} % of the rays that meet the surface pass through"
    if not scene.lambert:
        return Effect("opacity", True, text)
    if not scene.flat:
        return Effect("opacity", True, text, bounds.opacity if bounds else None, "pilot")
    # M of a plane is its color times its opacity.
    rows, columns = (max(a, b) for a, b in zip(through.shape, scene.albedo.shape[:2], strict=True))
    passed = np.asarray(resample(through, rows, columns), np.float64)[..., None]
    color = np.asarray(resample(scene.albedo, rows, columns), np.float64)
    mean = float(np.mean((1.0 - passed) * color))
    bound = float(np.sqrt(np.mean((passed * color) ** 2))) / mean if mean > 0 else None
    return Effect("opacity", True, text, bound, "bound")


def passing(scene: Analysis) -> NDArray[np.float64] | None:
    """(h, w) share of the rays that pass through; None if all is opaque."""
    opacity = scene.job.material.opacity
    if opacity is None or scene.own_bsdf or np.all(np.asarray(opacity) == 1.0):
        return None
    return 1.0 - np.atleast_2d(np.asarray(opacity, np.float64))


def bsdf_sampling(scene: Analysis) -> Effect:
    """Whether sampling the BSDF finds light that next-event estimation finds only with high variance."""
    job = scene.job
    width = np.radians(job.config.light.width)
    name = "bsdf_sampling"
    if width == 0.0:
        return Effect(name, False, "samples of the BSDF never hit a delta light", 0.0)
    if isinstance(scene.shape, FiberTile):
        lobe, text = scene.shape.scattering.narrowest, "narrowest lobe of the fibers"
        text += f" {np.degrees(lobe):.2g}°, light {job.config.light.width:g}°"
        if lobe >= WIDER * width:
            return Effect(name, False, f"{text}: sampling the light suffices", 0.0)
        return Effect(name, True, text)
    if scene.own_bsdf:
        return Effect(name, True, "the material's own BSDF, not analyzed")
    if scene.lambert:
        if job.config.light.width <= 20.0:
            text = f"Lambert under a light of {job.config.light.width:g}°: sampling the light is best"
            return Effect(name, False, text, 0.0)
        return Effect(name, True, "a wide light")
    material = job.material
    lobes = [2.0] if material.is_lambert else [2.0 * float(np.min(np.asarray(material.roughness))) ** 2]
    if material.clearcoat is not None:
        lobes.append(2.0 * float(np.min(np.asarray(material.clearcoat_roughness))) ** 2)
    if material.sheen is not None:
        # The fibers of sheen lean by less than about √α.
        lobes.append(float(np.min(np.asarray(material.sheen_roughness))))
    text = f"narrowest lobe {np.degrees(min(lobes)):.2g}°, light {job.config.light.width:g}°"
    if min(lobes) >= WIDER * width:
        return Effect(name, False, f"{text}: sampling the light suffices", 0.0)
    return Effect(name, True, text)
