"""``mbtf``: a fitted material as a BSDF of Mitsuba.

The material's value M is the outgoing radiance for unit irradiance, in 1/sr: the BSDF's value f, averaged
over the footprint and over the light kernel of the data. ``eval`` therefore returns ``M cos θ_i``.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import BeforeValidator, Field, PositiveFloat

from mbtf_core.config.settings import FileName, Settings
from mbtf_core.errors import InputError, UsageError
from mbtf_core.pictures import pixel_sigma
from mbtf_fit.backends.mitsuba.backend import Arithmetic
from mbtf_fit.backends.mitsuba.curvature import curvature, in_axes, rounded, with_normal_partials
from mbtf_fit.backends.mitsuba.evaluator import Evaluator, Values
from mbtf_fit.backends.mitsuba.frame import Frame
from mbtf_fit.backends.mitsuba.mixture import Mixture
from mbtf_fit.backends.mitsuba.names import BSDF_NAME, footprints_provided, options_of
from mbtf_fit.backends.mitsuba.partials import FootprintRequest, uv_partials
from mbtf_fit.backends.mitsuba.shade import DirectLight
from mbtf_fit.backends.mitsuba.shell import ShellHit, clamped
from mbtf_fit.backends.mitsuba.stored_material import StoredMaterial, read_material
from mbtf_fit.material.format import QUERY
from mbtf_fit.ops import Trace
from mbtf_gen.engine.types import (
    BSDFContext,
    BSDFSample3f,
    Color3f,
    Float,
    Mask,
    Point2f,
    Properties,
    Scene,
    SurfaceInteraction3f,
    Vector3f,
)

# Largest deviation from the conformance values, as a share of max(value, their mean), that loading accepts.
TOLERANCE = {"unrolled": 1e-4, "cooperative": 1e-4, "half": 1e-2}

# One conformance query of so many may deviate where view rays are traced.
MISSED_EDGES = 100

_log = logging.getLogger(__name__)
# Materials with a warning of missing footprints.
_warned: set[Path] = set()


def _pair(value: Any) -> Any:
    """A number for u and v, or one for each, separated by a comma."""
    parts = value.split(",") if isinstance(value, str) else [value]
    return parts if len(parts) > 2 else (parts[0], parts[-1])


class MaterialOptions(Settings):
    """Parameters of :class:`MbtfBSDF`."""

    material: FileName
    uv_scale: Annotated[tuple[PositiveFloat, PositiveFloat], BeforeValidator(_pair)] = Field(
        "1", validate_default=True
    )
    sigma: PositiveFloat | None = None
    networks: Arithmetic | None = None
    sampling: Literal["network", "cosine"] = "network"
    silhouettes: bool = False
    two_sided: bool = False


class MbtfBSDF(mi.BSDF):
    """A fitted material.

    Plugin parameters
    -----------------
    material : the material's folder
    uv_scale : tile widths per unit of the shape's texture coordinates (default 1), or those of u and of v as
        text, such as ``8,4``
    sigma : footprint in tile widths where the integrator provides none; default: that of the finest level
    networks : ``unrolled``, ``cooperative`` or ``half``; the default depends on variant and size
    sampling : ``network`` (default), the material's sampler, or ``cosine``
    silhouettes : whether heights are traced over the curved surface, which is their top, and rays that miss
        them pass through the shape (default false)
    two_sided : whether the back looks as the front, mirrored at the surface (default false)

    Raises
    ------
    InputError : the material cannot be read or used
    UsageError : a parameter is invalid
    """

    def __init__(self, props: Properties) -> None:
        # Errors must precede the registration of the instance: one that an exception's traceback keeps alive
        # would be called by every later render.
        name = f"{BSDF_NAME} '{props.id()}'" if props.id() else BSDF_NAME
        options = options_of(props, MaterialOptions, name)
        folder = Path(str(mi.file_resolver().resolve(options.material)))
        stored = read_material(folder)
        self.lattice = stored.lattice
        self.min_cos = dr.opaque(mi.Float, stored.min_cos)
        self.evaluator = Evaluator(stored, options.networks)
        _check_conformance(self.evaluator, stored)
        self.by_network, self.two_sided = options.sampling == "network", options.two_sided
        if options.silhouettes and self.two_sided:
            hint = "silhouettes trace the front alone: leave one of them out"
            raise UsageError("has both silhouettes and two_sided", where=name, hint=hint)
        self.shell = self.evaluator.shell if options.silhouettes else None
        if options.silhouettes and self.shell is None:
            hint = "fit the model relief, or leave silhouettes out"
            raise UsageError("has silhouettes, but its material knows no heights", where=name, hint=hint)
        self.uv_scale = mi.Point2f(*(dr.opaque(mi.Float, number) for number in options.uv_scale))
        self.sigma_given = options.sigma is not None
        self.sigma = dr.opaque(mi.Float, options.sigma or stored.lattice.sigma_range[0])
        self.folder, self.request = folder, FootprintRequest()
        super().__init__(props)
        known = mi.BSDFFlags
        self.m_flags = known.GlossyReflection | known.FrontSide | known.SpatiallyVarying | known.Anisotropic
        if self.two_sided:
            self.m_flags |= known.BackSide
        self.m_components = [self.m_flags]
        self.transmits = self.shell is not None or stored.transmittance is not None
        if self.transmits:
            through = known.Null | known.FrontSide | known.BackSide | known.SpatiallyVarying
            self.m_components = [self.m_flags, through]
            self.m_flags |= through

    def _warn_once(self, si: SurfaceInteraction3f) -> None:
        provided = footprints_provided.get() or hasattr(si, "footprint")
        if provided or self.sigma_given or self.folder in _warned:
            return
        _warned.add(self.folder)
        _log.warning(
            "%s: the integrator provides no footprint, so the finest level is used: use the integrator "
            "'mbtf_path', or set 'sigma'",
            self.folder,
        )

    def footprint(self, si: SurfaceInteraction3f) -> Float:
        """σ at hits in tile widths, from the area of a sample of a pixel on the surface."""
        dx, dy = uv_partials(si)
        area = dr.abs(dx.x * dy.y - dx.y * dy.x) * self.uv_scale.x * self.uv_scale.y
        return dr.select(area > 0, pixel_sigma(area), self.sigma)

    def uv(self, si: SurfaceInteraction3f) -> Point2f:
        """Positions in the tile at hits, uv."""
        return mi.Point2f(self.uv_scale.x * si.uv.x, 1.0 - self.uv_scale.y * si.uv.y / self.lattice.aspect)

    def _view(self, si: SurfaceInteraction3f) -> View:
        self._warn_once(si)
        frame, u = Frame.at(si, self.two_sided, self.uv_scale), self.uv(si)
        level = self.evaluator.level(self.footprint(si))
        wi = frame.to_tile(si.wi)
        if self.shell is None:
            return View(self, frame, u, level, wi, wi.z > 0)
        # The project's integrator gives them with the footprint.
        bent = si if footprints_provided.get() else with_normal_partials(si)
        form = in_axes(rounded(curvature(bent, frame.width), self.shell.depth), frame.x, frame.y)
        # Rays leave a mesh through its back, where shading normals of coarse ones may face them.
        front = dr.dot(si.n, si.to_world(si.wi)) > 0
        rise = dr.select(front, 0.0, -si.wi.z * si.t / frame.width)
        hit = self.shell.meet(
            u, level, wi, form, self.min_cos, rise, lambda tilt: frame.over(tilt).to_tile(si.wi)
        )
        frame = frame.over(hit.tilt)
        return View(self, frame, hit.u, level, hit.omega_o, front & (wi.z > 0), hit)

    def sample(
        self,
        ctx: BSDFContext,
        si: SurfaceInteraction3f,
        sample1: Float,
        sample2: Point2f,
        active: Mask = True,
    ) -> tuple[BSDFSample3f, Color3f]:
        """Sample a direction: reflection with weight f·cos/density, or, with the probability of the
        transmittance, transmission with weight 1."""
        view = self._view(si)
        through = view.transmission_probability(ctx)
        transmitted = active & (sample1 < through)
        reused = dr.clip((sample1 - through) / dr.maximum(1.0 - through, 1e-6), 0.0, 1.0)
        mixture = view.mixture()
        wo = mixture.sample(reused, sample2)
        good = active & ~transmitted & view.reflects(ctx) & view.front & (wo.z > 0)
        wo = dr.select(good, wo, mi.Vector3f(0, 0, 1))
        value, pdf = view.value(ctx, wo), view.density(mixture, wo) * (1.0 - through)
        good &= pdf > 0
        bs = dr.zeros(mi.BSDFSample3f, dr.width(wo))
        bs.wo = dr.select(transmitted, -si.wi, view.frame.to_local(wo))
        bs.pdf = dr.select(transmitted, through, dr.select(good, pdf, 0.0))
        bs.eta = 1.0
        kinds = (mi.UInt32(int(kind)) for kind in (mi.BSDFFlags.Null, mi.BSDFFlags.GlossyReflection))
        bs.sampled_type = dr.select(transmitted, *kinds)
        bs.sampled_component = dr.select(transmitted, mi.UInt32(1), 0)
        return bs, dr.select(transmitted, 1.0, dr.select(good, value / pdf, 0.0))

    def eval_pdf(
        self, ctx: BSDFContext, si: SurfaceInteraction3f, wo: Vector3f, active: Mask = True
    ) -> tuple[Color3f, Float]:
        """(f·cos, density) of a local direction."""
        view = self._view(si)
        to_light = view.frame.to_tile(wo)
        good = active & view.reflects(ctx) & view.front & view.above(to_light)
        pdf = view.density(view.mixture(), to_light) * (1.0 - view.transmission_probability(ctx))
        return dr.select(good, view.value(ctx, to_light), 0.0), dr.select(good, pdf, 0.0)

    # Dr.Jit drops what the caller does not use.
    def eval(self, ctx: BSDFContext, si: SurfaceInteraction3f, wo: Vector3f, active: Mask = True) -> Color3f:
        """f·cos of a local direction."""
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: BSDFContext, si: SurfaceInteraction3f, wo: Vector3f, active: Mask = True) -> Float:
        """Density of a local direction."""
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_null_transmission(self, si: SurfaceInteraction3f, active: Mask = True) -> Color3f:
        """Transmittance in the direction of the ray."""
        return dr.select(active, mi.Color3f(self._view(si).transmittance()), 0.0)

    def traverse(self, callback: Any) -> None:
        """Parameters: the textures' texels (all levels, padded to whole groups), ``uv_scale``, ``sigma``."""
        callback.put("uv_scale", self.uv_scale, mi.ParamFlags.NonDifferentiable)
        callback.put("sigma", self.sigma, mi.ParamFlags.NonDifferentiable)
        for name, textures in self.evaluator.textures.items():
            callback.put(name.replace(".", "_"), textures.buffer, mi.ParamFlags.Differentiable)
        if hasattr(mi.Texture, "filtered"):
            # Found by the scene, which then computes footprints.
            callback.put("footprint", self.request, mi.ParamFlags.NonDifferentiable)

    def to_string(self) -> str:
        """Text that Mitsuba prints."""
        return f"MbtfBSDF[material = {self.folder}, networks = {self.evaluator.arithmetic}]"


@dataclass(frozen=True)
class View:
    """A material at hits: position, level and view direction wi; directions are in the tile's frame.

    Of a curved surface `hit` says where view rays meet the heights. `front` are hits that face the viewer.
    """

    bsdf: MbtfBSDF
    frame: Frame
    u: Point2f
    level: Float
    wi: Vector3f
    front: Mask
    hit: ShellHit | None = None

    def transmittance(self) -> Float:
        """Transparent fraction of the footprint."""
        # Along the ray itself, not its mirror image: rays to and fro pass the same holes.
        ray = mi.Vector3f(self.wi.x, self.wi.y, self.frame.side * self.wi.z)
        found = self.bsdf.evaluator.transmittance(self.u, self.level, ray)
        if self.hit is None:
            return found
        # Rays pass the back of a shape where they leave its shell, and through holes.
        return dr.select(
            self.front, 1.0 - self.hit.share * (1.0 - found), dr.select(self.hit.leaves, 1.0, found)
        )

    def above(self, wo: Vector3f) -> Mask:
        """Whether light may come from a direction: from above, or from anywhere around a curved surface."""
        return wo.z > 0 if self.hit is None else (wo.z > 0) | ~self.hit.flat

    def reflects(self, ctx: BSDFContext) -> bool:
        """Whether the context enables reflection."""
        return bool(ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0))

    def transmission_probability(self, ctx: BSDFContext) -> Float:
        """The transmittance where the context enables it, else 0."""
        if not (self.bsdf.transmits and ctx.is_enabled(mi.BSDFFlags.Null, 1)):
            return mi.Float(0.0)
        return self.transmittance()

    @cached_property
    def values(self) -> Values:
        """Values of stage 1 for the viewer at wi."""
        viewer, hit = clamped(self.wi, self.bsdf.min_cos), self.hit
        return self.bsdf.evaluator.stage1(self.u, self.level, viewer, None if hit is None else hit.values)

    def mixture(self) -> Mixture:
        """Density of the sampled directions."""
        bsdf = self.bsdf
        return bsdf.evaluator.mixture(self.values, self.wi) if bsdf.by_network else Mixture.cosine(self.wi)

    def density(self, mixture: Mixture, wo: Vector3f) -> Float:
        """Density of a direction per solid angle on the surface."""
        length = self.frame.length(wo)
        return mixture.density(wo) * length * dr.square(length)

    def value(self, ctx: BSDFContext, wo: Vector3f) -> Color3f:
        """f·cos; light travels towards wi, or away from it where paths start at lights."""
        viewer, light = (clamped(w, self.bsdf.min_cos) for w in (self.wi, wo))
        # Of the surface over that in the tile's frame.
        cosine = dr.rcp(self.frame.length(wo))
        evaluator, hit = self.bsdf.evaluator, self.hit
        if hit is None or ctx.mode == mi.TransportMode.Importance:
            values = self.values
            if ctx.mode == mi.TransportMode.Importance:
                values, light = evaluator.stage1(self.u, self.level, light), viewer
            value = evaluator.value(values, light, frame=self.frame) * cosine * dr.maximum(wo.z, 0.0)
            return value if hit is None else value * hit.share
        least = self.bsdf.min_cos
        lit = DirectLight(wo, least, hit.flat, hit.curvature, hit.shell.depth, hit.heights)
        cosine *= dr.maximum(wo.z, dr.select(hit.flat, 0.0, least))
        return evaluator.value(self.values, light, lit, self.frame) * cosine * hit.share


def _check_conformance(evaluator: Evaluator, stored: StoredMaterial) -> None:
    """Refuse an evaluator that does not reproduce the material's conformance values."""
    expected = stored.conformance["rgb"]
    found = evaluator.evaluate(*(stored.conformance[name] for name in QUERY))
    scale = np.maximum(np.abs(expected), max(float(expected.mean()), 1e-12))
    deviations = np.sort(np.max(np.abs(found - expected) / scale, axis=1))
    # A traced ray may just miss an edge that it hits in other arithmetic.
    traces = any(isinstance(op, Trace) for op in stored.operations)
    allowed = len(expected) // MISSED_EDGES if traces else 0
    worst = float(deviations[len(expected) - 1 - allowed])
    if not worst <= TOLERANCE[evaluator.arithmetic]:
        raise InputError(
            f"the renderer's plugin does not reproduce its conformance values ({100 * worst:.2g}% off)",
            where=stored.folder,
            hint="set 'networks' to 'unrolled': half precision is too coarse for this material"
            if evaluator.arithmetic == "half"
            else "it was fitted by another version: fit it again",
        )


def check_scene(scene: Scene) -> None:
    """Refuse meshes with an ``mbtf`` material that have no texture coordinates.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene to check.

    Raises
    ------
    InputError
        There is such a mesh.
    """
    for shape in scene.shapes():
        if shape.is_mesh() and isinstance(shape.bsdf(), MbtfBSDF) and not shape.has_vertex_texcoords():
            raise InputError(
                "the mesh has an mbtf material but no texture coordinates",
                where=f"shape '{shape.id()}'",
                hint="add uv coordinates: they map the material's tile to the mesh",
            )
