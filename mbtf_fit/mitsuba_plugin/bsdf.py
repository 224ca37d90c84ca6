"""``mbtf``: a fitted material as a BSDF of Mitsuba.

The material's value M is the radiance that leaves under light of unit irradiance, in 1/sr: the BSDF's value
f, averaged over the footprint and over the light kernel of the data. ``eval`` therefore is ``M cos θ_i``.
"""

from __future__ import annotations

import logging
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import drjit as dr
import mitsuba as mi
import numpy as np

from mbtf_core.errors import InputError, UsageError
from mbtf_fit.mitsuba_plugin.evaluator import Evaluator
from mbtf_fit.mitsuba_plugin.lobe_fit import fit_lobes
from mbtf_fit.mitsuba_plugin.lobes import LobeTextures, Mixture
from mbtf_fit.mitsuba_plugin.material_arrays import StoredMaterial, read_material
from mbtf_fit.mitsuba_plugin.network import Arithmetic
from mbtf_fit.mitsuba_plugin.registration import BSDF_NAME, refuse_unknown
from mbtf_gen.pictures.camera import pixel_sigma

# Length of the directions' projection on the surface beyond which no material has data: lower directions are
# answered by the lowest that have some (see docs/rendering.md).
LARGEST_SINE = 0.99**0.5
# Largest deviation from the conformance values, as a share of max(value, their mean), that loading accepts.
TOLERANCE = {"unrolled": 1e-4, "cooperative": 1e-4, "half": 1e-2}

PARAMETERS = ("material", "uv_scale", "sigma", "networks", "sampling")

_log = logging.getLogger(__name__)
# Materials whose missing footprint was told.
_warned: set[Path] = set()
# Whether the integrator that is tracing now passes footprints to the BSDFs.
FOOTPRINTS_PASSED: ContextVar[bool] = ContextVar("footprints_passed", default=False)


@dataclass(frozen=True)
class Frame:
    """The tile's frame at hits, as a turn (and perhaps a reflection) of the shading frame about the
    normal."""

    c: Any
    s: Any
    hand: Any

    @classmethod
    def at(cls, si: Any) -> Frame:
        """x along ∂p/∂u, y towards decreasing v of Mitsuba (images have row 0 there at v = 0)."""
        du, dv = si.sh_frame.to_local(si.dp_du), si.sh_frame.to_local(si.dp_dv)
        length = dr.sqrt(dr.fma(du.x, du.x, du.y * du.y))
        good = length > 0
        hand = dr.select(du.x * dv.y - du.y * dv.x > 0, mi.Float(-1.0), 1.0)
        return cls(dr.select(good, du.x / length, 1.0), dr.select(good, du.y / length, 0.0), hand)

    def to_tile(self, w: Any) -> Any:
        """Local direction → the tile's."""
        return mi.Vector3f(
            dr.fma(self.c, w.x, self.s * w.y), self.hand * dr.fma(self.c, w.y, -self.s * w.x), w.z
        )

    def to_local(self, w: Any) -> Any:
        """Inverse of :meth:`to_tile`."""
        y = self.hand * w.y
        return mi.Vector3f(dr.fma(self.c, w.x, -self.s * y), dr.fma(self.s, w.x, self.c * y), w.z)


def clamped(w: Any) -> Any:
    """Directions lower than all data, raised to the lowest that has some."""
    sine = dr.sqrt(dr.fma(w.x, w.x, w.y * w.y))
    low = sine > LARGEST_SINE
    scale = dr.select(low, LARGEST_SINE / sine, 1.0)
    return mi.Vector3f(w.x * scale, w.y * scale, dr.select(low, (1.0 - LARGEST_SINE**2) ** 0.5, w.z))


class MbtfBSDF(mi.BSDF):
    """A fitted material.

    Plugin parameters
    -----------------
    material : the material's folder
    uv_scale : tile widths per unit of the shape's texture coordinates (default 1)
    sigma : footprint in tile widths where the integrator hands over none; default: the finest level's
    networks : ``unrolled``, ``cooperative`` or ``half``; default: what suits variant and size
    sampling : ``lobes`` (default) or ``cosine``

    Raises
    ------
    InputError : the material cannot be read or used
    UsageError : a parameter makes no sense
    """

    def __init__(self, props: Any) -> None:
        # Whatever may fail comes before the renderer registers the instance: one that was registered and is
        # kept by an exception's traceback would be called by every later render.
        if "material" not in props:
            raise UsageError(
                "names no material", where=self._place(props), hint="give it: 'material': 'folder/'"
            )
        refuse_unknown(props, PARAMETERS, self._place(props))
        folder = Path(str(mi.file_resolver().resolve(str(props["material"]))))
        stored = read_material(folder)
        self.lattice = stored.lattice
        networks = self._choice(props, "networks", get_args(Arithmetic))
        self.evaluator = Evaluator(stored, networks)
        _check_conformance(self.evaluator, stored)
        self.lobes = None
        if self._choice(props, "sampling", ("lobes", "cosine")) != "cosine":
            self.lobes = LobeTextures(fit_lobes(stored))
        self.uv_scale = self._positive(props, "uv_scale", 1.0)
        self.sigma_given = "sigma" in props
        self.sigma = self._positive(props, "sigma", stored.lattice.sigma_range[0])
        self.folder = folder
        super().__init__(props)
        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.SpatiallyVarying
        flags |= mi.BSDFFlags.Anisotropic
        self.m_components = [flags]
        self.m_flags = flags
        self.has_holes = stored.transmittance is not None
        if self.has_holes:
            through = mi.BSDFFlags.Null | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            through |= mi.BSDFFlags.SpatiallyVarying
            self.m_components = [flags, through]
            self.m_flags = flags | through

    @staticmethod
    def _place(props: Any) -> str:
        return f"{BSDF_NAME} '{props.id()}'" if props.id() else BSDF_NAME

    def _positive(self, props: Any, name: str, default: float) -> Any:
        value = props.get(name, default)
        if not isinstance(value, (int, float)) or not 0 < value < np.inf:
            raise UsageError(f"{name} must be a positive number, not {value}", where=self._place(props))
        return dr.opaque(mi.Float, float(value))

    def _choice(self, props: Any, name: str, choices: tuple[str, ...]) -> Any:
        value = props.get(name, None)
        if value is not None and value not in choices:
            raise UsageError(
                f"{name} must be one of {', '.join(choices)}, not {value}", where=self._place(props)
            )
        return value

    def _warn_once(self) -> None:
        if FOOTPRINTS_PASSED.get() or self.sigma_given or self.folder in _warned:
            return
        _warned.add(self.folder)
        _log.warning(
            "%s: the integrator hands over no footprint, so the finest level is read: use the integrator "
            "'mbtf_path', or set 'sigma'",
            self.folder,
        )

    def footprint(self, si: Any) -> Any:
        """σ at hits, in tile widths: the pixel rule for the area of a pixel on the surface."""
        dx, dy = si.duv_dx, si.duv_dy
        area = dr.abs(dx.x * dy.y - dx.y * dy.x) * dr.square(self.uv_scale)
        return dr.select(area > 0, pixel_sigma(area), self.sigma)

    def place(self, si: Any) -> Any:
        """uv of the tile at hits."""
        return mi.Point2f(self.uv_scale * si.uv.x, 1.0 - self.uv_scale * si.uv.y / self.lattice.aspect)

    def _view(self, si: Any) -> View:
        self._warn_once()
        frame = Frame.at(si)
        return View(self, si, frame, frame.to_tile(si.wi))

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
        """Direction and weight: f·cos/density of what is reflected; 1 of what passes through a hole, which
        happens with the probability of the transmittance."""
        view = self._view(si)
        hole = view.hole(ctx)
        passes = active & (sample1 < hole)
        again = dr.clip((sample1 - hole) / dr.maximum(1.0 - hole, 1e-6), 0.0, 1.0)
        wo = view.mixture().sample(again, sample2)
        good = active & ~passes & view.reflects(ctx) & (view.wi.z > 0) & (wo.z > 0)
        wo = dr.select(good, wo, mi.Vector3f(0, 0, 1))
        value, pdf = view.eval_pdf(ctx, wo)
        pdf *= 1.0 - hole
        good &= pdf > 0
        bs = dr.zeros(mi.BSDFSample3f, dr.width(wo))
        bs.wo = dr.select(passes, -si.wi, view.frame.to_local(wo))
        bs.pdf = dr.select(passes, hole, dr.select(good, pdf, 0.0))
        bs.eta = 1.0
        bs.sampled_type = dr.select(
            passes, mi.UInt32(int(mi.BSDFFlags.Null)), mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
        )
        bs.sampled_component = dr.select(passes, mi.UInt32(1), mi.UInt32(0))
        return bs, dr.select(passes, 1.0, dr.select(good, value / pdf, 0.0))

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """(f·cos, density) of a local direction."""
        view = self._view(si)
        good = active & view.reflects(ctx) & (view.wi.z > 0) & (wo.z > 0)
        value, pdf = view.eval_pdf(ctx, view.frame.to_tile(wo))
        return dr.select(good, value, 0.0), dr.select(good, pdf * (1.0 - view.hole(ctx)), 0.0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """f·cos of a local direction."""
        view = self._view(si)
        value = view.value(ctx, view.frame.to_tile(wo))
        return dr.select(active & view.reflects(ctx) & (view.wi.z > 0) & (wo.z > 0), value, 0.0)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        """Density of a local direction."""
        view = self._view(si)
        pdf = view.mixture().density(view.frame.to_tile(wo)) * (1.0 - view.hole(ctx))
        return dr.select(active & view.reflects(ctx) & (wo.z > 0), pdf, 0.0)

    def eval_null_transmission(self, si: Any, active: Any = True) -> Any:
        """Share that passes straight through holes."""
        return dr.select(active, mi.Color3f(self._view(si).transmittance()), 0.0)

    def traverse(self, callback: Any) -> None:
        """Parameters: the textures' texels (all levels, padded to whole groups), ``uv_scale``, ``sigma``."""
        callback.put("uv_scale", self.uv_scale, mi.ParamFlags.NonDifferentiable)
        callback.put("sigma", self.sigma, mi.ParamFlags.NonDifferentiable)
        callback.put("pyramid", self.evaluator.pyramid.buffer, mi.ParamFlags.Differentiable)
        if self.evaluator.offset_texture is not None:
            callback.put("offset_texture", self.evaluator.offset_texture.buffer, mi.ParamFlags.Differentiable)

    def to_string(self) -> str:
        """Description that Mitsuba prints."""
        return f"MbtfBSDF[material = {self.folder}, networks = {self.evaluator.arithmetic}]"


@dataclass(frozen=True)
class View:
    """A material at hits, seen from si.wi; directions are in the tile's frame."""

    bsdf: MbtfBSDF
    si: Any
    frame: Frame
    wi: Any

    def transmittance(self) -> Any:
        """Share of the footprint that is seen through holes."""
        bsdf = self.bsdf
        level = bsdf.evaluator.level(bsdf.footprint(self.si))
        return bsdf.evaluator.transmittance(bsdf.place(self.si), level, self.wi)

    def reflects(self, ctx: Any) -> bool:
        """Whether the context asks for what is reflected."""
        return bool(ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0))

    def hole(self, ctx: Any) -> Any:
        """Probability of passing through: the transmittance, where the context asks for it."""
        if not (self.bsdf.has_holes and ctx.is_enabled(mi.BSDFFlags.Null, 1)):
            return mi.Float(0.0)
        return self.transmittance()

    def mixture(self) -> Mixture:
        """Density that directions are drawn from."""
        bsdf = self.bsdf
        if bsdf.lobes is None:
            return Mixture.cosine(self.wi)
        return bsdf.lobes.at(bsdf.place(self.si), bsdf.evaluator.level(bsdf.footprint(self.si)), self.wi)

    def value(self, ctx: Any, wo: Any) -> Any:
        """f·cos; light travels towards si.wi, or away from it where a light's paths are traced."""
        bsdf = self.bsdf
        viewer, light = clamped(self.wi), clamped(wo)
        if ctx.mode == mi.TransportMode.Importance:
            viewer, light = light, viewer
        evaluator = bsdf.evaluator
        features = evaluator.features(bsdf.place(self.si), evaluator.level(bsdf.footprint(self.si)), viewer)
        return evaluator.value(features, light, viewer) * dr.maximum(wo.z, 0.0)

    def eval_pdf(self, ctx: Any, wo: Any) -> tuple[Any, Any]:
        """(f·cos, density)."""
        return self.value(ctx, wo), self.mixture().density(wo)


def _check_conformance(evaluator: Evaluator, stored: StoredMaterial) -> None:
    """The material's own queries give its own answers, or it is refused."""
    wanted = stored.conformance["rgb"]
    found = evaluator.evaluate(*(stored.conformance[name] for name in ("u", "sigma", "omega_i", "omega_o")))
    scale = np.maximum(np.abs(wanted), max(float(wanted.mean()), 1e-12))
    worst = float(np.max(np.abs(found - wanted) / scale))
    if not worst <= TOLERANCE[evaluator.arithmetic]:
        raise InputError(
            f"the renderer's plugin does not give its conformance values ({100 * worst:.2g} % off)",
            where=stored.folder,
            hint="set 'networks' to 'unrolled': half precision is too coarse for this material"
            if evaluator.arithmetic == "half"
            else "it was fitted by another version: fit it again, or use that version's plugin",
        )
