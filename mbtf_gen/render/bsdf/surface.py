r"""How the displaced surface reflects: the project's own BSDF, which returns no more than it receives.

For a view direction i and a light direction o (local cosines μi, μo) the value is

    f = (1 - m) · [ F-lobe(F0 = 0.08·specular) + base/π · (1-E(μi))(1-E(μo)) / (1-Ē) ]
      +    m    · [ F-lobe(F0 = base) + Fms/π · (1-A(μi))(1-A(μo)) / (1-Ā) ]

where m is `metallic`, an F-lobe is ``F·D·G2/(4 μi μo)`` with GGX facets of α = roughness², E is the share
that the dielectric's lobe reflects and A that of a lobe with F = 1 (bars are cosine-weighted averages over
the hemisphere). The diffuse term takes what the lobe leaves over (Kelemen and Szirmay-Kalos 2001); the last
one gives back what scatters several times between metal facets (Kulla and Conty 2017), with
``Fms = F̄²Ā/(1-F̄(1-Ā))``. Both are reciprocal, and a white surface reflects exactly everything. A clear
coat of F0 = 4 % takes its share c·E_c of both directions from what lies below: ``f = c·f_c +
(1-cE_c(μi))(1-cE_c(μo))·f``. Sheen, of weight w and color k, lies on top of it all and takes its share once,
at the direction where it is larger: ``f = w·k·f_s + min(t(μi), t(μo))·f`` with ``t = 1 - w·max(k)·E_s``.

What a material does not have costs nothing: terms without maps or constants are left out when the kernel is
built.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.render.bsdf.microfacet import (
    MIRROR_ALPHA,
    EnergyTables,
    distribution,
    grazing_reflectance,
    half_tangent2,
    is_mirror,
    lost_light,
    lost_light_pdf,
    schlick,
    smith,
    visible_normal,
)
from mbtf_gen.render.bsdf.sheen import SheenTables, sheen_value

CLEARCOAT_REFLECTANCE = 0.04
# A shading normal that would face away from the viewer is bent until its cosine is this.
SMALLEST_COSINE = 0.01
# Least and greatest chance, without a coat, with which sampling chooses the lobe.
LOBE_CHANCES = (0.1, 0.98)


@cache
def energy_tables(variant: str) -> EnergyTables:
    """Tables of the current Mitsuba variant, made once per process."""
    return EnergyTables()


@cache
def sheen_tables(variant: str) -> SheenTables:
    """Tables of the current Mitsuba variant, made once per process."""
    return SheenTables()


@dataclass(frozen=True)
class Lobe:
    """A GGX lobe at lanes' hits: α, roughness √α, reflectances F0 and F90, and the facets' energies
    (L, B) towards the viewer."""

    roughness: Any
    normal: Any
    grazing: Any
    tables: EnergyTables
    towards_viewer: tuple[Any, Any]

    @property
    def alpha(self) -> Any:
        """α, at least :data:`MIRROR_ALPHA`."""
        return dr.maximum(dr.square(self.roughness), MIRROR_ALPHA)

    @property
    def mirror(self) -> Any:
        """Lanes whose lobe is a mirror."""
        return is_mirror(self.roughness)

    def fresnel(self, cosine: Any) -> Any:
        """Reflectance of a facet seen under a cosine."""
        s = schlick(cosine)
        return self.normal * (1.0 - s) + self.grazing * s

    def share(self, pair: tuple[Any, Any]) -> Any:
        """Reflectance of the lobe from the facets' (L, B)."""
        return self.normal * (1.0 - pair[0] - pair[1]) + self.grazing * pair[1]

    def value_pdf(self, wi: Any, wo: Any) -> tuple[Any, Any]:
        """(f·μo, density of sampling wo); 0 for mirrors."""
        alpha = self.alpha
        d = dr.select(self.mirror, 0.0, distribution(half_tangent2(wi, wo), alpha))
        si, so = smith(wi.z, alpha), smith(wo.z, alpha)
        rest = d / (4.0 * wi.z)
        cosine = dr.dot(wi, dr.normalize(wi + wo))
        return self.fresnel(cosine) * (rest / (1.0 + si + so)), rest / (1.0 + si)

    def sample(self, wi: Any, xi: Any) -> tuple[Any, Any]:
        """(wo, weight f·μo/density of this lobe alone); exact for mirrors."""
        alpha = self.alpha
        h = dr.select(self.mirror, mi.Vector3f(0, 0, 1), visible_normal(wi, alpha, xi))
        wo = dr.fma(2.0 * dr.dot(wi, h), h, -wi)
        si, so = smith(wi.z, alpha), smith(dr.maximum(wo.z, 1e-7), alpha)
        share = dr.select(self.mirror, 1.0, (1.0 + si) / (1.0 + si + so))
        return wo, self.fresnel(dr.dot(wi, h)) * dr.select(wo.z > 0, share, 0.0)


@dataclass(frozen=True)
class SurfaceParts:
    """Which terms of the value a surface has; decided before a kernel is built."""

    diffuse: bool = True
    specular: bool = False
    metallic: bool = False
    clearcoat: bool = False
    sheen: bool = False
    slopes: bool = False
    opacity: bool = False


class Surface:
    """A surface's maps and the terms that they call for.

    Parameters
    ----------
    parts : terms that are simulated
    textures : ``base_color``, ``roughness``, ``metallic``, ``specular``, ``clearcoat``,
        ``clearcoat_roughness``, ``sheen``, ``sheen_color``, ``sheen_roughness``, ``slopes``, ``opacity`` → Mitsuba textures; those
        that no term needs may be missing. `slopes` (residual slopes along u and y, in tile widths per tile
        width) are added to the mesh's own.
    """

    def __init__(self, parts: SurfaceParts, textures: dict[str, Any]) -> None:
        self.parts = parts
        self.textures = textures
        # Whether rays may end up below the surface.
        self.transmits = parts.opacity
        glossy = parts.specular or parts.metallic or parts.clearcoat
        self.tables = energy_tables(mi.variant()) if glossy else None
        self.sheen_tables = sheen_tables(mi.variant()) if parts.sheen else None

    def at(self, si: Any, towards_viewer: Any) -> SurfacePoint:
        """The surface at hits; `si` needs p, n, uv and its validity."""
        return SurfacePoint(self, si, towards_viewer)

    def opacity(self, si: Any) -> Any:
        """Share of rays that the surface stops at hits."""
        return self.textures["opacity"].eval_1(si)


class SurfacePoint:
    """A surface at lanes' hits, seen from given directions. Directions given and returned are in the
    scene."""

    def __init__(self, surface: Surface, si: Any, towards_viewer: Any) -> None:
        parts, maps, tables = surface.parts, surface.textures, surface.tables
        self.parts, self.tables = parts, tables
        self.face = si.n
        self.visible = dr.dot(si.n, towards_viewer) > 0
        normal = si.n
        if parts.slopes:
            normal = _tilted(si, maps["slopes"], towards_viewer)
        self.frame = mi.Frame3f(normal)
        self.wi = self.frame.to_local(towards_viewer)
        # Written so that NaN counts as seen: it must reach the value, where it is found and drawn again.
        self.visible &= ~(self.wi.z <= 0)
        self.wi.z = dr.maximum(self.wi.z, 1e-6)
        self.base = maps["base_color"].eval(si) if parts.diffuse or parts.metallic else mi.Color3f(0.0)
        self.metallic = maps["metallic"].eval_1(si) if parts.metallic else mi.Float(0.0)
        if parts.specular or parts.metallic:
            self._lobe(maps, si)
        if parts.clearcoat:
            self._clearcoat(maps, si)
        if parts.sheen:
            assert surface.sheen_tables is not None
            self.sheen_tables = surface.sheen_tables
            self._sheen(maps, si)

    def _lobe(self, maps: dict[str, Any], si: Any) -> None:
        roughness = dr.clip(maps["roughness"].eval_1(si), 0.0, 1.0)
        tables = self.tables
        assert tables is not None
        pair, mean = tables.at(self.wi.z, roughness), tables.average(roughness)
        dielectric = 0.08 * maps["specular"].eval_1(si) if self.parts.specular else mi.Float(0.0)
        edge = grazing_reflectance(dielectric)
        m = self.metallic
        normal = dr.lerp(mi.Color3f(dielectric), self.base, m)
        grazing = dr.lerp(mi.Color3f(edge), grazing_reflectance(self.base), m)
        self.lobe = Lobe(roughness, normal, grazing, tables, pair)
        # What the dielectric's lobe leaves to the diffuse term, by direction and on average.
        self.dielectric, self.edge = dielectric, edge
        self.left = 1.0 - (dielectric * (1.0 - pair[0] - pair[1]) + edge * pair[1])
        self.left_mean = 1.0 - (dielectric * (1.0 - mean[0] - mean[1]) + edge * mean[1])
        if self.parts.metallic:
            f = self.base + (grazing_reflectance(self.base) - self.base) * (1.0 / 21.0)
            # Share of what one scattering loses that several give back; as a value, by direction.
            self.returned = m * dr.square(f) * (1.0 - mean[0]) / (1.0 - f * mean[0])
            self.several = self.returned / mean[0]
            self.lost = pair[0]

    def _clearcoat(self, maps: dict[str, Any], si: Any) -> None:
        roughness = dr.clip(maps["clearcoat_roughness"].eval_1(si), 0.0, 1.0)
        tables = self.tables
        assert tables is not None
        pair = tables.at(self.wi.z, roughness)
        self.clearcoat_weight = maps["clearcoat"].eval_1(si)
        self.clearcoat = Lobe(roughness, mi.Color3f(CLEARCOAT_REFLECTANCE), mi.Color3f(1.0), tables, pair)

    def _sheen(self, maps: dict[str, Any], si: Any) -> None:
        self.sheen_roughness = dr.clip(maps["sheen_roughness"].eval_1(si), 0.0, 1.0)
        self.sheen = maps["sheen"].eval_1(si) * maps["sheen_color"].eval(si)
        self.sheen_area, albedo = self.sheen_tables.at(self.wi.z, self.sheen_roughness)
        self.sheen_share = dr.max(self.sheen) * albedo

    def _broad(self, cosine: Any) -> Any:
        """π·f of everything but coat, lobes and sheen, for the cosine of wo."""
        diffuse = self.base * (1.0 - self.metallic)
        if not (self.parts.specular or self.parts.metallic):
            return diffuse
        assert self.tables is not None
        lost, b = self.tables.at(cosine, self.lobe.roughness)
        left = 1.0 - (self.dielectric * (1.0 - lost - b) + self.edge * b)
        value = diffuse * (self.left * left / self.left_mean) if self.parts.diffuse else mi.Color3f(0.0)
        if self.parts.metallic:
            value += self.several * (self.lost * lost)
        return value

    def _chances(self) -> tuple[Any, Any, Any, Any]:
        """Chances with which sampling chooses (sheen, the coat, the lobe, what metal scatters several
        times); the rest is cosine-distributed."""
        sheen, coat, lobe, several = (mi.Float(0.0) for _ in range(4))
        # Energy that goes towards the viewer, about.
        below = _mean(self.base)
        if self.parts.specular or self.parts.metallic:
            # Energies towards the viewer.
            strong = _mean(self.lobe.share(self.lobe.towards_viewer))
            broad = _mean(self.base * (1.0 - self.metallic)) * self.left
            again = _mean(self.returned) * self.lost if self.parts.metallic else mi.Float(0.0)
            below = dr.maximum(below, strong)
            lobe = dr.clip(strong / dr.maximum(strong + broad + again, 1e-6), *LOBE_CHANCES)
            lobe = dr.select(broad + again > 0, lobe, 1.0)
            if self.parts.metallic:
                several = (1.0 - lobe) * again / dr.maximum(broad + again, 1e-12)
        if self.parts.clearcoat:
            share = self.clearcoat_weight * _mean(self.clearcoat.share(self.clearcoat.towards_viewer))
            coat = dr.clip(share / dr.maximum(share + (1.0 - share) * _mean(self.base), 1e-6), 0.05, 0.9)
            coat = dr.select(self.clearcoat_weight > 0, coat, 0.0)
            below = dr.maximum(below, share)
            lobe *= 1.0 - coat
            several *= 1.0 - coat
        if self.parts.sheen:
            # Twice its energy, for even samples fit it less well than those of the other terms.
            share = 2.0 * self.sheen_share
            rest = (1.0 - self.sheen_share) * below
            sheen = dr.clip(share / dr.maximum(share + rest, 1e-6), 0.05, 0.9)
            sheen = dr.select(dr.max(self.sheen) > 0, sheen, 0.0)
            coat, lobe, several = (c * (1.0 - sheen) for c in (coat, lobe, several))
        return sheen, coat, lobe, several

    def _below_clearcoat(self, cosine: Any) -> Any:
        """What the coat lets through of both directions."""
        viewer = 1.0 - self.clearcoat_weight * _mean(self.clearcoat.share(self.clearcoat.towards_viewer))
        light = 1.0 - self.clearcoat_weight * _mean(
            self.clearcoat.share(self.clearcoat.tables.at(cosine, self.clearcoat.roughness))
        )
        return viewer * light

    def _below_sheen(self, albedo: Any) -> Any:
        """What sheen leaves of both directions, its albedo towards the light given: its larger share of the
        two is taken once, so that the rest is reciprocal and together no more than what comes in."""
        return 1.0 - dr.maximum(self.sheen_share, dr.max(self.sheen) * albedo)

    def _local(self, wo: Any) -> tuple[Any, Any]:
        """(f·μo, density) for local wo with z > 0, without mirrors."""
        chance_sheen, chance_coat, chance, chance_several = self._chances()
        value = self._broad(wo.z) * (dr.inv_pi * wo.z)
        pdf = (1.0 - chance_sheen - chance_coat - chance - chance_several) * (dr.inv_pi * wo.z)
        if self.parts.metallic:
            pdf += chance_several * lost_light_pdf(wo.z, self.lobe.alpha)
        if self.parts.specular or self.parts.metallic:
            lobe, lobe_pdf = self.lobe.value_pdf(self.wi, wo)
            value += lobe
            pdf += chance * lobe_pdf
        if self.parts.clearcoat:
            coat, coat_pdf = self.clearcoat.value_pdf(self.wi, wo)
            value = value * self._below_clearcoat(wo.z) + self.clearcoat_weight * coat
            pdf += chance_coat * coat_pdf
        if self.parts.sheen:
            area, albedo = self.sheen_tables.at(wo.z, self.sheen_roughness)
            sheen = sheen_value(self.wi, wo, self.sheen_roughness, self.sheen_area, area)
            value = value * self._below_sheen(albedo) + self.sheen * sheen
            pdf += chance_sheen * (0.5 * dr.inv_pi)
        return value, pdf

    def _leaves(self, wo: Any, omega: Any) -> Any:
        """Lanes whose direction leaves above the shading plane and above the face."""
        return self.visible & ~(wo.z <= 0) & ~(dr.dot(self.face, omega) <= 0)

    def eval_pdf(self, omega: Any) -> tuple[Any, Any]:
        """(f·cos, density with which :meth:`sample` chooses it) of a direction, mirrors left out."""
        wo = self.frame.to_local(omega)
        good = self._leaves(wo, omega)
        wo.z = dr.maximum(wo.z, 1e-6)
        value, pdf = self._local(wo)
        return dr.select(good, value, 0.0), dr.select(good, pdf, 0.0)

    def sample(self, xi_lobe: Any, xi: Any) -> tuple[Any, Any, Any]:
        """(direction, weight f·cos/density, density; infinite for a mirrored direction)."""
        chance_sheen, chance_coat, chance, chance_several = self._chances()
        wo = mi.warp.square_to_cosine_hemisphere(xi)
        mirrored = mi.Bool(False)
        single = mi.Color3f(0.0)
        if self.parts.metallic:
            chosen = xi_lobe < chance + chance_several
            wo = dr.select(chosen, lost_light(self.lobe.alpha, xi), wo)
        if self.parts.specular or self.parts.metallic:
            chosen = xi_lobe < chance
            wo_lobe, weight = self.lobe.sample(self.wi, xi)
            wo = dr.select(chosen, wo_lobe, wo)
            mirrored |= chosen & self.lobe.mirror
            single = weight / dr.maximum(chance, 1e-6)
            if self.parts.clearcoat:
                single *= self._below_clearcoat(dr.maximum(wo.z, 1e-6))
        if self.parts.clearcoat:
            chosen = (xi_lobe > 1.0 - chance_coat - chance_sheen) & (xi_lobe <= 1.0 - chance_sheen)
            wo_coat, weight = self.clearcoat.sample(self.wi, xi)
            wo = dr.select(chosen, wo_coat, wo)
            flat = chosen & self.clearcoat.mirror
            single = dr.select(flat, self.clearcoat_weight * weight / dr.maximum(chance_coat, 1e-6), single)
            mirrored = (mirrored & ~chosen) | flat
        if self.parts.sheen:
            chosen = xi_lobe > 1.0 - chance_sheen
            wo = dr.select(chosen, mi.warp.square_to_uniform_hemisphere(xi), wo)
            albedo = self.sheen_tables.at(dr.maximum(wo.z, 1e-6), self.sheen_roughness)[1]
            single *= self._below_sheen(albedo)
        omega = self.frame.to_world(wo)
        good = self._leaves(wo, omega)
        wo.z = dr.maximum(wo.z, 1e-6)
        if self.parts.specular or self.parts.metallic or self.parts.clearcoat or self.parts.sheen:
            value, pdf = self._local(wo)
            weight = dr.select(mirrored, single, value / dr.maximum(pdf, 1e-30))
            pdf = dr.select(mirrored, dr.inf, pdf)
        else:
            weight, pdf = self._broad(wo.z), dr.inv_pi * wo.z
            if self.parts.slopes:
                # A direction of NaN would meet nothing and bring no light.
                weight = dr.select(dr.isnan(self.wi.z), dr.nan, weight)
        return omega, dr.select(good, weight, 0.0), dr.select(good, pdf, 0.0)


def _mean(color: Any) -> Any:
    """Mean of a color's channels; `dr.mean` makes the number of lanes a part of the kernel, so that every
    launch of another size would be compiled anew."""
    return (color.x + color.y + color.z) * (1.0 / 3.0)


def _tilted(si: Any, slopes: Any, towards_viewer: Any) -> Any:
    """Normal of the face with residual slopes added, bent towards the viewer where it would face away."""
    extra = slopes.eval_3(si)
    n = si.n
    tilted = dr.normalize(mi.Normal3f(dr.fma(-extra.x, n.z, n.x), dr.fma(-extra.y, n.z, n.y), n.z))
    # Only where the face itself looks up: slopes add to slopes of a height field, which a face seen from
    # below does not have.
    tilted = dr.select(n.z > 0, tilted, n)
    short = dr.maximum(SMALLEST_COSINE - dr.dot(tilted, towards_viewer), 0.0)
    return dr.select(short > 0, dr.normalize(tilted + short * towards_viewer), tilted)
