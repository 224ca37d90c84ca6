r"""The project's BSDF, which conserves energy.

For a view direction i and a light direction o (local cosines μi, μo) its value is

    f = (1 - m) · [ F-lobe(F0 = 0.08·specular) + base/π · (1-E(μi))(1-E(μo)) / (1-Ē) ]
      +    m    · [ F-lobe(F0 = base) + Fms/π · (1-A(μi))(1-A(μo)) / (1-Ā) ]

where m is `metallic`. An F-lobe is ``F·D·G2/(4 μi μo)`` with GGX facets of α = roughness² (Walter et al.
2007). E is the directional albedo of the dielectric's lobe, A that of a lobe with F = 1; bars are
cosine-weighted averages over the hemisphere. The diffuse term scatters the energy that the lobe does not
reflect (Kelemen and Szirmay-Kalos 2001, "A Microfacet Based Coupled Specular-Matte BRDF Model"). The last
term adds multiple scattering between metal facets (Kulla and Conty 2017, "Revisiting Physically Based Shading
at Imageworks"), with ``Fms = F̄²Ā/(1-F̄(1-Ā))``. Both are reciprocal, and a white surface has albedo 1.

A clear coat of weight c and F0 = 4% attenuates both directions by its directional albedo E_c:
``f = c·f_c + (1-cE_c(μi))(1-cE_c(μo))·f``. Sheen of weight w and color k is the topmost layer. It attenuates
once, by the larger of its two albedos: ``f = w·k·f_s + min(t(μi), t(μo))·f`` with ``t = 1 - w·max(k)·E_s``.

Terms without maps or constants are not compiled into the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_core.data.schema import CLEARCOAT_F0
from mbtf_gen.engine.types import (
    Color3f,
    Float,
    Mask,
    Normal3f,
    Point2f,
    SurfaceInteraction3f,
    Texture,
    Vector3f,
)
from mbtf_gen.render.bsdf.microfacet import (
    MIRROR_ALPHA,
    EnergyTables,
    distribution,
    grazing_reflectance,
    half_tangent2,
    is_mirror,
    missing_energy_pdf,
    sample_missing_energy,
    schlick,
    smith,
    visible_normal,
)
from mbtf_gen.render.bsdf.sheen import SheenTables, sheen_value

# Smallest cosine between shading normal and viewer; shading normals below it are bent towards the viewer.
SMALLEST_COSINE = 0.01
# Smallest and largest probability of sampling the lobe, without a clear coat.
LOBE_PROBABILITIES = (0.1, 0.98)


@cache
def _tables(kind: Any, variant: str) -> Any:
    """Tables of the current Mitsuba variant, made once per process."""
    return kind()


@dataclass(frozen=True)
class GgxLobe:
    """A GGX lobe: roughness √α, reflectances F0 and F90, energy tables, and their (L, B) for the viewer."""

    roughness: Float
    normal: Color3f
    grazing: Color3f
    tables: EnergyTables
    energy: tuple[Float, Float]

    @property
    def alpha(self) -> Float:
        """α, at least :data:`MIRROR_ALPHA`."""
        return dr.maximum(dr.square(self.roughness), MIRROR_ALPHA)

    @property
    def mirror(self) -> Mask:
        """Lanes whose lobe is a mirror."""
        return is_mirror(self.roughness)

    def fresnel(self, cosine: Float) -> Color3f:
        """Fresnel reflectance of a facet, by the cosine of incidence (Schlick 1994)."""
        s = schlick(cosine)
        return self.normal * (1.0 - s) + self.grazing * s

    def albedo(self, pair: tuple[Float, Float]) -> Color3f:
        """Directional albedo of the lobe, from (L, B) of the tables."""
        return self.normal * (1.0 - pair[0] - pair[1]) + self.grazing * pair[1]

    def value_pdf(self, wi: Vector3f, wo: Vector3f) -> tuple[Color3f, Float]:
        """(f·μo, density of sampling wo); 0 for mirrors."""
        alpha = self.alpha
        d = dr.select(self.mirror, 0.0, distribution(half_tangent2(wi, wo), alpha))
        si, so = smith(wi.z, alpha), smith(wo.z, alpha)
        rest = d / (4.0 * wi.z)
        cosine = dr.dot(wi, dr.normalize(wi + wo))
        return self.fresnel(cosine) * (rest / (1.0 + si + so)), rest / (1.0 + si)

    def sample(self, wi: Vector3f, xi: Point2f) -> tuple[Vector3f, Color3f]:
        """(wo, weight f·μo/density) of this lobe alone; exact for mirrors."""
        alpha = self.alpha
        h = dr.select(self.mirror, mi.Vector3f(0, 0, 1), visible_normal(wi, alpha, xi))
        wo = dr.fma(2.0 * dr.dot(wi, h), h, -wi)
        si, so = smith(wi.z, alpha), smith(dr.maximum(wo.z, 1e-7), alpha)
        shadowing = dr.select(self.mirror, 1.0, (1.0 + si) / (1.0 + si + so))
        return wo, self.fresnel(dr.dot(wi, h)) * dr.select(wo.z > 0, shadowing, 0.0)


@dataclass(frozen=True)
class SurfaceParts:
    """Terms of a surface's BSDF, fixed before a kernel is compiled."""

    diffuse: bool = True
    specular: bool = False
    metallic: bool = False
    clearcoat: bool = False
    sheen: bool = False
    slopes: bool = False
    opacity: bool = False


# Values of textures that no term needs, or that a term may lack.
DEFAULTS = {
    "base_color": 0.5,
    "roughness": 0.5,
    "clearcoat_roughness": 0.1,
    "sheen_color": 1.0,
    "sheen_roughness": 0.3,
}


class Surface:
    """Reflection of a tile: its textures and the terms of the BSDF.

    Parameters
    ----------
    parts : terms that are simulated
    textures : Mitsuba textures by the names of ``mbtf_surface``. Those that no term needs may be missing;
        ``slopes`` are residual slopes along x and y, which are added to those of the geometry.
    cutoff : opacity from which the surface is opaque, and below which it is a hole; 0 for partial opacity

    Attributes
    ----------
    transmits : whether rays may be below the surface
    """

    def __init__(self, parts: SurfaceParts, textures: dict[str, Texture], cutoff: float = 0.0) -> None:
        self.parts = parts
        self.cutoff = cutoff
        self.textures = textures
        self.transmits = parts.opacity
        glossy = parts.specular or parts.metallic or parts.clearcoat
        self.tables: Any = _tables(EnergyTables, mi.variant()) if glossy else None
        self.sheen_tables: Any = _tables(SheenTables, mi.variant()) if parts.sheen else None

    def at(self, si: SurfaceInteraction3f, towards_viewer: Vector3f) -> SurfacePoint:
        """The BSDF at surface interactions, of which p, n, uv and validity are used."""
        return SurfacePoint(self, si, towards_viewer)

    def opacity(self, si: SurfaceInteraction3f) -> Float:
        """Probability that a surface interaction stops a ray, from the opacity mask."""
        if not self.parts.opacity:
            return mi.Float(1.0)
        opacity = self.textures["opacity"].eval_1(si)
        return dr.select(opacity >= self.cutoff, 1.0, 0.0) if self.cutoff > 0.0 else opacity


class SurfacePoint:
    """The BSDF at one surface interaction per lane, for given view directions. Directions in arguments and
    results are in the scene's frame; shading normals may differ from the geometric normal."""

    def __init__(self, surface: Surface, si: SurfaceInteraction3f, towards_viewer: Vector3f) -> None:
        parts, maps = surface.parts, surface.textures
        self.parts, self.tables, self.sheen_tables = parts, surface.tables, surface.sheen_tables
        self.geometric_normal = si.n
        self.visible = dr.dot(si.n, towards_viewer) > 0
        normal = si.n
        if parts.slopes:
            normal = _shading_normal(si, maps["slopes"], towards_viewer)
        self.frame = mi.Frame3f(normal)
        self.wi = self.frame.to_local(towards_viewer)
        # NaN counts as visible: it must reach the value, where the sample is detected and drawn again.
        self.visible &= ~(self.wi.z <= 0)
        self.wi.z = dr.maximum(self.wi.z, 1e-6)
        self.base = maps["base_color"].eval(si) if parts.diffuse or parts.metallic else mi.Color3f(0.0)
        self.metallic = maps["metallic"].eval_1(si) if parts.metallic else mi.Float(0.0)
        if parts.specular or parts.metallic:
            self._lobe(maps, si)
        if parts.clearcoat:
            self._clearcoat(maps, si)
        if parts.sheen:
            self._sheen(maps, si)

    def _lobe(self, maps: dict[str, Texture], si: SurfaceInteraction3f) -> None:
        roughness = dr.clip(maps["roughness"].eval_1(si), 0.0, 1.0)
        pair, mean = self.tables.at(self.wi.z, roughness), self.tables.average(roughness)
        dielectric = 0.08 * maps["specular"].eval_1(si) if self.parts.specular else mi.Float(0.0)
        edge = grazing_reflectance(dielectric)
        m = self.metallic
        normal = dr.lerp(mi.Color3f(dielectric), self.base, m)
        grazing = dr.lerp(mi.Color3f(edge), grazing_reflectance(self.base), m)
        self.lobe = GgxLobe(roughness, normal, grazing, self.tables, pair)
        # Energy that the dielectric's lobe does not reflect: 1 - E(μi) and 1 - Ē.
        self.dielectric, self.edge = dielectric, edge
        self.transmitted = 1.0 - (dielectric * (1.0 - pair[0] - pair[1]) + edge * pair[1])
        self.transmitted_mean = 1.0 - (dielectric * (1.0 - mean[0] - mean[1]) + edge * mean[1])
        if self.parts.metallic:
            f = self.base + (grazing_reflectance(self.base) - self.base) * (1.0 / 21.0)
            # Fms: the fraction of the energy missing from single scattering that multiple scattering adds.
            # F̄ of Schlick's approximation is F0 + (F90 - F0)/21.
            self.multiple_albedo = m * dr.square(f) * (1.0 - mean[0]) / (1.0 - f * mean[0])
            self.multiple_scale = self.multiple_albedo / mean[0]
            self.missing = pair[0]

    def _clearcoat(self, maps: dict[str, Texture], si: SurfaceInteraction3f) -> None:
        roughness = dr.clip(maps["clearcoat_roughness"].eval_1(si), 0.0, 1.0)
        pair = self.tables.at(self.wi.z, roughness)
        self.clearcoat_weight = maps["clearcoat"].eval_1(si)
        normal, grazing = mi.Color3f(CLEARCOAT_F0), mi.Color3f(1.0)
        self.clearcoat = GgxLobe(roughness, normal, grazing, self.tables, pair)

    def _sheen(self, maps: dict[str, Texture], si: SurfaceInteraction3f) -> None:
        self.sheen_roughness = dr.clip(maps["sheen_roughness"].eval_1(si), 0.0, 1.0)
        self.sheen = maps["sheen"].eval_1(si) * maps["sheen_color"].eval(si)
        self.sheen_q, albedo = self.sheen_tables.at(self.wi.z, self.sheen_roughness)
        self.sheen_albedo = dr.max(self.sheen) * albedo

    def _diffuse(self, cosine: Float) -> Color3f:
        """π·f of the diffuse term and of multiple scattering, by the cosine of wo."""
        diffuse = self.base * (1.0 - self.metallic)
        if not (self.parts.specular or self.parts.metallic):
            return diffuse
        missing, b = self.tables.at(cosine, self.lobe.roughness)
        transmitted = 1.0 - (self.dielectric * (1.0 - missing - b) + self.edge * b)
        value = mi.Color3f(0.0)
        if self.parts.diffuse:
            value = diffuse * (self.transmitted * transmitted / self.transmitted_mean)
        if self.parts.metallic:
            value += self.multiple_scale * (self.missing * missing)
        return value

    def _probabilities(self) -> tuple[Float, Float, Float, Float]:
        """Probabilities of sampling (sheen, clear coat, lobe, multiple scattering of metal); otherwise the
        cosine-weighted hemisphere is sampled."""
        sheen, coat, lobe, multiple = (mi.Float(0.0) for _ in range(4))
        # Approximate directional albedos of the terms.
        below = _mean(self.base)
        if self.parts.specular or self.parts.metallic:
            strong = _mean(self.lobe.albedo(self.lobe.energy))
            broad = _mean(self.base * (1.0 - self.metallic)) * self.transmitted
            again = _mean(self.multiple_albedo) * self.missing if self.parts.metallic else mi.Float(0.0)
            below = dr.maximum(below, strong)
            lobe = dr.clip(strong / dr.maximum(strong + broad + again, 1e-6), *LOBE_PROBABILITIES)
            lobe = dr.select(broad + again > 0, lobe, 1.0)
            if self.parts.metallic:
                multiple = (1.0 - lobe) * again / dr.maximum(broad + again, 1e-12)
        if self.parts.clearcoat:
            share = self.clearcoat_weight * _mean(self.clearcoat.albedo(self.clearcoat.energy))
            coat = dr.clip(share / dr.maximum(share + (1.0 - share) * _mean(self.base), 1e-6), 0.05, 0.9)
            coat = dr.select(self.clearcoat_weight > 0, coat, 0.0)
            below = dr.maximum(below, share)
            lobe *= 1.0 - coat
            multiple *= 1.0 - coat
        if self.parts.sheen:
            # Twice its albedo, because uniform sampling fits sheen less well than the other terms' sampling.
            share = 2.0 * self.sheen_albedo
            rest = (1.0 - self.sheen_albedo) * below
            sheen = dr.clip(share / dr.maximum(share + rest, 1e-6), 0.05, 0.9)
            sheen = dr.select(dr.max(self.sheen) > 0, sheen, 0.0)
            coat, lobe, multiple = (c * (1.0 - sheen) for c in (coat, lobe, multiple))
        return sheen, coat, lobe, multiple

    def _clearcoat_transmittance(self, cosine: Float) -> Float:
        """Transmittance of the clear coat for both directions, by the cosine of wo."""
        viewer = 1.0 - self.clearcoat_weight * _mean(self.clearcoat.albedo(self.clearcoat.energy))
        light = 1.0 - self.clearcoat_weight * _mean(
            self.clearcoat.albedo(self.clearcoat.tables.at(cosine, self.clearcoat.roughness))
        )
        return viewer * light

    def _sheen_transmittance(self, albedo: Float) -> Float:
        """Transmittance of the sheen layer, from its albedo towards the light. The larger of the two albedos
        counts once, so that the sum is reciprocal and conserves energy."""
        return 1.0 - dr.maximum(self.sheen_albedo, dr.max(self.sheen) * albedo)

    def _local(self, wo: Vector3f) -> tuple[Color3f, Float]:
        """(f·μo, density) of a local direction with z > 0, without mirrors."""
        p_sheen, p_clearcoat, p_lobe, p_multiple = self._probabilities()
        value = self._diffuse(wo.z) * (dr.inv_pi * wo.z)
        pdf = (1.0 - p_sheen - p_clearcoat - p_lobe - p_multiple) * (dr.inv_pi * wo.z)
        if self.parts.metallic:
            pdf += p_multiple * missing_energy_pdf(wo.z, self.lobe.alpha)
        if self.parts.specular or self.parts.metallic:
            lobe, lobe_pdf = self.lobe.value_pdf(self.wi, wo)
            value += lobe
            pdf += p_lobe * lobe_pdf
        if self.parts.clearcoat:
            coat, coat_pdf = self.clearcoat.value_pdf(self.wi, wo)
            value = value * self._clearcoat_transmittance(wo.z) + self.clearcoat_weight * coat
            pdf += p_clearcoat * coat_pdf
        if self.parts.sheen:
            q, albedo = self.sheen_tables.at(wo.z, self.sheen_roughness)
            sheen = sheen_value(self.wi, wo, self.sheen_roughness, self.sheen_q, q)
            value = value * self._sheen_transmittance(albedo) + self.sheen * sheen
            pdf += p_sheen * (0.5 * dr.inv_pi)
        return value, pdf

    def _above_horizon(self, wo: Vector3f, omega: Vector3f) -> Mask:
        """Lanes whose direction is above the planes of both the shading and the geometric normal."""
        return self.visible & ~(wo.z <= 0) & ~(dr.dot(self.geometric_normal, omega) <= 0)

    def eval_pdf(self, omega: Vector3f) -> tuple[Color3f, Float]:
        """(f·cos, density of :meth:`sample` in 1/sr) of a direction, without mirrors."""
        wo = self.frame.to_local(omega)
        good = self._above_horizon(wo, omega)
        wo.z = dr.maximum(wo.z, 1e-6)
        value, pdf = self._local(wo)
        return dr.select(good, value, 0.0), dr.select(good, pdf, 0.0)

    def sample(self, xi_lobe: Float, xi: Point2f) -> tuple[Vector3f, Color3f, Float]:
        """(direction, weight f·cos/density, density in 1/sr); the density is infinite for mirrors."""
        p_sheen, p_clearcoat, p_lobe, p_multiple = self._probabilities()
        wo = mi.warp.square_to_cosine_hemisphere(xi)
        mirrored = mi.Bool(False)
        single = mi.Color3f(0.0)
        if self.parts.metallic:
            chosen = xi_lobe < p_lobe + p_multiple
            wo = dr.select(chosen, sample_missing_energy(self.lobe.alpha, xi), wo)
        if self.parts.specular or self.parts.metallic:
            chosen = xi_lobe < p_lobe
            wo_lobe, weight = self.lobe.sample(self.wi, xi)
            wo = dr.select(chosen, wo_lobe, wo)
            mirrored |= chosen & self.lobe.mirror
            single = weight / dr.maximum(p_lobe, 1e-6)
            if self.parts.clearcoat:
                single *= self._clearcoat_transmittance(dr.maximum(wo.z, 1e-6))
        if self.parts.clearcoat:
            chosen = (xi_lobe > 1.0 - p_clearcoat - p_sheen) & (xi_lobe <= 1.0 - p_sheen)
            wo_coat, weight = self.clearcoat.sample(self.wi, xi)
            wo = dr.select(chosen, wo_coat, wo)
            flat = chosen & self.clearcoat.mirror
            single = dr.select(flat, self.clearcoat_weight * weight / dr.maximum(p_clearcoat, 1e-6), single)
            mirrored = (mirrored & ~chosen) | flat
        if self.parts.sheen:
            chosen = xi_lobe > 1.0 - p_sheen
            wo = dr.select(chosen, mi.warp.square_to_uniform_hemisphere(xi), wo)
            albedo = self.sheen_tables.at(dr.maximum(wo.z, 1e-6), self.sheen_roughness)[1]
            single *= self._sheen_transmittance(albedo)
        omega = self.frame.to_world(wo)
        good = self._above_horizon(wo, omega)
        wo.z = dr.maximum(wo.z, 1e-6)
        if self.parts.specular or self.parts.metallic or self.parts.clearcoat or self.parts.sheen:
            value, pdf = self._local(wo)
            weight = dr.select(mirrored, single, value / dr.maximum(pdf, 1e-30))
            pdf = dr.select(mirrored, dr.inf, pdf)
        else:
            weight, pdf = self._diffuse(wo.z), dr.inv_pi * wo.z
            if self.parts.slopes:
                # A NaN direction would hit nothing, so that the sample would count as black.
                weight = dr.select(dr.isnan(self.wi.z), dr.nan, weight)
        return omega, dr.select(good, weight, 0.0), dr.select(good, pdf, 0.0)


def _mean(color: Color3f) -> Float:
    """Mean of a color's channels. With `dr.mean` the number of lanes would be part of the kernel, so that
    each launch size would be compiled anew."""
    return (color.x + color.y + color.z) * (1.0 / 3.0)


def _shading_normal(si: SurfaceInteraction3f, slopes: Texture, towards_viewer: Vector3f) -> Normal3f:
    """Geometric normal with residual slopes added, bent towards the viewer where it would face away."""
    extra = slopes.eval_3(si)
    n = si.n
    tilted = dr.normalize(mi.Normal3f(dr.fma(-extra.x, n.z, n.x), dr.fma(-extra.y, n.z, n.y), n.z))
    # Only for upward normals: residual slopes add to the slopes of a height field, which surfaces seen from
    # below do not have.
    tilted = dr.select(n.z > 0, tilted, n)
    short = dr.maximum(SMALLEST_COSINE - dr.dot(tilted, towards_viewer), 0.0)
    return dr.select(short > 0, dr.normalize(tilted + short * towards_viewer), tilted)
