"""Surfaces as Mitsuba BSDFs: the project's own, ``mbtf_surface``, and Mitsuba's in the project's loop.

The generator's loop calls a :class:`~mbtf_gen.render.bsdf.surface.Surface` directly; the registered plugin
makes the same surface usable in any Mitsuba scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import (
    BSDF,
    BSDFSample3f,
    Float,
    Mask,
    Point2f,
    Properties,
    Spectrum,
    SurfaceInteraction3f,
    Vector3f,
)
from mbtf_gen.render.bsdf.surface import DEFAULTS, Surface, SurfaceParts

# Parameters of ``mbtf_surface`` that add a term.
TERMS = tuple(part.name for part in fields(SurfaceParts) if part.name != "diffuse")


class SurfaceBSDF(mi.BSDF):
    """``mbtf_surface``: the project's BSDF as a Mitsuba plugin.

    Plugin parameters are the names of :data:`DEFAULTS` and :data:`TERMS`, each a texture or a number. The
    simulated terms are those whose parameters are given. Opacity is only supported by the generator's own
    loop; with the number ``opacity_cutoff`` it is 0 below that and else 1.
    """

    def __init__(self, props: Properties) -> None:
        super().__init__(props)
        given = [name for name in TERMS if name in props]
        textures = {name: props.get_texture(name, number) for name, number in DEFAULTS.items()}
        textures |= {name: props.get_texture(name) for name in given}
        parts = SurfaceParts(bool(props.get("diffuse", True)), **dict.fromkeys(given, True))
        self.surface = Surface(parts, textures, float(props.get("opacity_cutoff", 0.0)))
        flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
        if parts.specular or parts.metallic or parts.clearcoat:
            flags |= mi.BSDFFlags.GlossyReflection
        self.m_components = [flags]
        self.m_flags = flags

    def sample(
        self, ctx: Any, si: SurfaceInteraction3f, sample1: Float, sample2: Point2f, active: Mask = True
    ) -> tuple[BSDFSample3f, Spectrum]:
        """Sample a direction; returns it with the weight f·cos/density."""
        omega, weight, pdf = self.surface.at(si, si.to_world(si.wi)).sample(sample1, sample2)
        bs = dr.zeros(mi.BSDFSample3f, dr.width(omega))
        mirrored = dr.isinf(pdf)
        bs.wo = si.to_local(omega)
        bs.pdf = dr.select(mirrored, 1.0, pdf)
        bs.eta = 1.0
        glossy = mi.UInt32(int(mi.BSDFFlags.GlossyReflection))
        bs.sampled_type = dr.select(mirrored, mi.UInt32(int(mi.BSDFFlags.DeltaReflection)), glossy)
        bs.sampled_component = 0
        good = active & (pdf > 0)
        bs.pdf = dr.select(good, bs.pdf, 0.0)
        return bs, dr.select(good, weight, 0.0)

    def eval_pdf(
        self, ctx: Any, si: SurfaceInteraction3f, wo: Vector3f, active: Mask = True
    ) -> tuple[Spectrum, Float]:
        """(f·cos, density) of a local direction."""
        value, pdf = self.surface.at(si, si.to_world(si.wi)).eval_pdf(si.to_world(wo))
        return dr.select(active, value, 0.0), dr.select(active, pdf, 0.0)

    def eval(self, ctx: Any, si: SurfaceInteraction3f, wo: Vector3f, active: Mask = True) -> Spectrum:
        """f·cos of a local direction."""
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: SurfaceInteraction3f, wo: Vector3f, active: Mask = True) -> Float:
        """Density of a local direction."""
        return self.eval_pdf(ctx, si, wo, active)[1]


class PartSurface:
    """Surfaces of several parts, with the interface of one; interactions name their part."""

    def __init__(self, parts: Sequence[Any]) -> None:
        self.surfaces = parts
        self.transmits = any(surface.transmits for surface in parts)
        self.parts = SurfaceParts(opacity=any(surface.parts.opacity for surface in parts))

    def opacity(self, si: SurfaceInteraction3f) -> Float:
        """Probability that a surface interaction stops a ray."""
        out = self.surfaces[0].opacity(si)
        for number, surface in enumerate(self.surfaces[1:], 1):
            out = dr.select(si.prim_index == number, surface.opacity(si), out)
        return out

    def at(self, si: SurfaceInteraction3f, towards_viewer: Vector3f) -> PartSurfacePoint:
        """The surfaces at surface interactions."""
        points = [surface.at(si, towards_viewer) for surface in self.surfaces]
        return PartSurfacePoint(points, [si.prim_index == k for k in range(len(points))])


class PartSurfacePoint:
    """Surfaces of several parts at one surface interaction per lane."""

    def __init__(self, points: Sequence[Any], masks: Sequence[Mask]) -> None:
        self.points, self.masks = points, masks

    def eval_pdf(self, omega: Vector3f) -> tuple[Spectrum, Float]:
        """(f·cos, density) of a direction in the scene."""
        return self._chosen([point.eval_pdf(omega) for point in self.points])

    def sample(self, xi_lobe: Float, xi: Point2f) -> tuple[Vector3f, Spectrum, Float]:
        """(direction in the scene, weight, density; infinite for a delta lobe)."""
        return self._chosen([point.sample(xi_lobe, xi) for point in self.points])

    def _chosen(self, values: Sequence[tuple[Any, ...]]) -> Any:
        out = values[0]
        for mask, value in zip(self.masks[1:], values[1:], strict=True):
            out = tuple(dr.select(mask, new, old) for new, old in zip(value, out, strict=True))
        return out


class MitsubaSurface:
    """A BSDF of Mitsuba with the interface of :class:`~mbtf_gen.render.bsdf.surface.Surface`."""

    def __init__(self, bsdf: BSDF) -> None:
        self.bsdf = bsdf
        self.transmits = bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission))
        self.parts = SurfaceParts()

    def at(self, si: SurfaceInteraction3f, towards_viewer: Vector3f) -> MitsubaSurfacePoint:
        """The BSDF at surface interactions."""
        return MitsubaSurfacePoint(self.bsdf, si)


class MitsubaSurfacePoint:
    """A BSDF of Mitsuba at one surface interaction per lane."""

    def __init__(self, bsdf: BSDF, si: SurfaceInteraction3f) -> None:
        self.bsdf, self.si, self.context = bsdf, si, mi.BSDFContext()

    def eval_pdf(self, omega: Vector3f) -> tuple[Spectrum, Float]:
        """(f·cos, density) of a direction in the scene."""
        value, pdf = self.bsdf.eval_pdf(self.context, self.si, self.si.to_local(omega))
        return value, pdf

    def sample(self, xi_lobe: Float, xi: Point2f) -> tuple[Vector3f, Spectrum, Float]:
        """(direction in the scene, weight, density; infinite for a delta lobe)."""
        bs, weight = self.bsdf.sample(self.context, self.si, xi_lobe, xi)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        return self.si.to_world(bs.wo), weight, dr.select(delta, dr.inf, bs.pdf)


def surface_of(bsdf: BSDF) -> Surface | MitsubaSurface:
    """Interface of the generator's loop to a loaded BSDF."""
    return bsdf.surface if isinstance(bsdf, SurfaceBSDF) else MitsubaSurface(bsdf)
