r"""Hints: what the geometry of a data set tells about a query before anything is learned.

For a query (u, σ, ω_i, ω_o) the view rays of one or more places of the footprint are traced to the heights
(:class:`~mbtf_fit.ops.lookup.Trace`). At each intersection, maps and horizons that are filtered to the
footprint give irradiance, normal and single scattering (:class:`~mbtf_fit.ops.shade.Shade`). Hints are means
over the places: height of the intersection, then those.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mbtf_core.data.lattice import Lattice
from mbtf_core.images.resample import resample
from mbtf_fit.ops.constants import (
    AZIMUTHS,
    COATED_CHANNELS,
    DIELECTRIC,
    DIFFUSE_CHANNELS,
    FIBER_CHANNELS,
    FIBERS,
    GLOSSY_CHANNELS,
    HEIGHTS,
    HORIZONS,
    LIGHT_WIDTH,
    MAP_CHANNELS,
    MAPS,
)
from mbtf_fit.ops.fibers import FiberFrame
from mbtf_fit.ops.lookup import Trace
from mbtf_fit.ops.shade import Shade, grazing_reflectance
from mbtf_fit.surface.facets import (
    coat_reflectance,
    doubled_scatter,
    grazing_albedo,
    light_widening,
    mean_grazing_albedo,
    own_facets,
    own_shadowing,
    projections,
    schlick,
    shown,
    slope_density,
)
from mbtf_fit.surface.fibers import fiber_frame, fiber_maps
from mbtf_fit.surface.heightfield import DeviceCopies, HeightfieldTracer
from mbtf_fit.surface.lookup import Packing, lookup
from mbtf_fit.surface.prefilter import lookup_sigma, prefiltered_levels
from mbtf_fit.surface.slopes import slope_distributions

if TYPE_CHECKING:
    from mbtf_core.data.geometry import Geometry

# Reflectance of the surface where the data set states none.
UNKNOWN_COLOR = 0.5
# Added to the weight of a clear coat where its roughness is averaged.
LEAST_COAT = 1e-3
# F0 of a dielectric per unit of `specular`, as in mbtf_gen.render.bsdf.surface.
DIELECTRIC_F0 = 0.08


@dataclass(frozen=True)
class KnownSurface:
    """Heights and prefiltered maps of a tile.

    Attributes
    ----------
    lattice : levels of the data
    heights : (H, W) tensor, z of the traced grid in tile widths; row 0 is the side ``v → 1``
    maps : tuple of (rows, columns, channels) tensors
        Prefiltered maps by level, coarsest first: levels 0 to k, or to k + 1 where lookups are finer.
    horizons : tuple of (rows, columns, 2·azimuths) tensors
        Prefiltered horizon angles in radians by level, then their squares: levels 0 to k.
    light_width : RMS angle per axis of the light kernel, in radians
    dielectric : F0 of the surface where it is no metal
    fibers : tuple of (rows, columns, 7) tensors
        Prefiltered maps of fibers by level, like `maps`; none for a surface without fibers.
    """

    lattice: Lattice
    heights: Tensor
    maps: tuple[Tensor, ...]
    horizons: tuple[Tensor, ...]
    light_width: float
    dielectric: float
    fibers: tuple[Tensor, ...] = ()

    @classmethod
    def of(cls, geometry: Geometry, lattice: Lattice, light_width: float) -> KnownSurface:
        """Filter the geometry of a data set for its levels.

        Parameters
        ----------
        lattice : levels of the data
        light_width : RMS angle per axis of the light kernel, in degrees
        """
        angles = HeightfieldTracer(geometry.heights, geometry.aspect).horizons(AZIMUTHS)
        # A grid coarser than the texels is interpolated linearly: a Fourier series would ring.
        rows, columns = (max(a, b) for a, b in zip(lattice.shape(), angles.shape, strict=False))
        if (rows, columns) != tuple(angles.shape[:2]):
            angles = torch.from_numpy(np.asarray(resample(angles.numpy(), rows, columns), np.float32))
        finer = Lattice(lattice.finest + 1, lattice.aspect)
        horizons = torch.cat([angles, angles.square()], -1)
        fibers = fiber_maps(geometry)
        return cls(
            lattice,
            torch.from_numpy(geometry.heights.copy()),
            tuple(_map_levels(geometry, finer)),
            tuple(prefiltered_levels(horizons, lattice)),
            math.radians(light_width),
            DIELECTRIC_F0 * float(np.mean(0.0 if geometry.specular is None else geometry.specular)),
            () if fibers is None else tuple(prefiltered_levels(fibers, finer)),
        )

    def with_heights(self, heights: Tensor) -> KnownSurface:
        """The same maps on other heights (H, W)."""
        out = replace(self, heights=heights)
        # Not packed again.
        tables = ("map_table", "horizon_table", "_map_copies", "_horizon_copies")
        vars(out).update({name: getattr(self, name) for name in tables})
        return out

    def tensors(self) -> dict[str, Tensor]:
        """Its tensors by their names in a material."""
        return {
            HEIGHTS: self.heights[..., None],
            LIGHT_WIDTH: torch.tensor(self.light_width),
            DIELECTRIC: torch.tensor(self.dielectric),
            **{f"{MAPS}.{level}": t for level, t in enumerate(self.maps)},
            **{f"{HORIZONS}.{level}": t for level, t in enumerate(self.horizons)},
            **{f"{FIBERS}.{level}": t for level, t in enumerate(self.fibers)},
        }

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], lattice: Lattice) -> KnownSurface:
        """Inverse of :meth:`tensors`.

        Raises
        ------
        KeyError : a tensor is missing
        ValueError : a tensor has the shape of another lattice, or is no surface below the reference plane
        """
        finer = Lattice(lattice.finest + 1, lattice.aspect)
        heights = _take(tensors, HEIGHTS, (None, None, 1))[..., 0]
        if heights.numel() == 0 or not bool((heights <= 0).all() and heights.isfinite().all()):
            raise ValueError(f"'{HEIGHTS}'")
        channels = tensors[f"{MAPS}.0"].shape[-1:]
        if tuple(channels) not in {(n,) for n in MAP_CHANNELS}:
            raise ValueError(f"'{MAPS}.0'")
        stored = range(finer.finest + (f"{MAPS}.{finer.finest}" in tensors))
        fibers = stored if f"{FIBERS}.0" in tensors else ()
        levels = range(lattice.finest + 1)
        return cls(
            lattice,
            heights,
            tuple(_take(tensors, f"{MAPS}.{s}", (*finer.shape(s), *channels)) for s in stored),
            tuple(_take(tensors, f"{HORIZONS}.{s}", (*lattice.shape(s), 2 * AZIMUTHS)) for s in levels),
            float(_take(tensors, LIGHT_WIDTH, ())),
            float(_take(tensors, DIELECTRIC, ())),
            tuple(_take(tensors, f"{FIBERS}.{s}", (*finer.shape(s), FIBER_CHANNELS)) for s in fibers),
        )

    @property
    def glossy(self) -> bool:
        """Whether the maps describe a glossy lobe."""
        return self.maps[0].shape[2] >= GLOSSY_CHANNELS

    @property
    def coated(self) -> bool:
        """Whether the maps describe a clear coat."""
        return self.maps[0].shape[2] == COATED_CHANNELS

    @cached_property
    def tracer(self) -> HeightfieldTracer:
        """Traces view rays to the heights."""
        return HeightfieldTracer(self.heights.cpu().numpy(), self.lattice.aspect)

    @cached_property
    def map_table(self) -> tuple[Tensor, Packing]:
        """All levels of the maps, one after the other."""
        return _packed(self.maps)

    @cached_property
    def horizon_table(self) -> tuple[Tensor, Packing]:
        """All levels of the horizons, one after the other."""
        return _packed(self.horizons)

    @cached_property
    def fiber_table(self) -> tuple[Tensor, Packing]:
        """All levels of the maps of fibers, one after the other."""
        return _packed(self.fibers)

    @cached_property
    def _fiber_copies(self) -> DeviceCopies:
        return DeviceCopies(self.fiber_table[0])

    @cached_property
    def _map_copies(self) -> DeviceCopies:
        return DeviceCopies(self.map_table[0])

    @cached_property
    def _horizon_copies(self) -> DeviceCopies:
        return DeviceCopies(self.horizon_table[0])

    def intersections(
        self, trace: Trace, u: Tensor, level: Tensor, omega_o: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Mean height (n, 1), uv (n, 2·places) and heights (n, places) of the intersections of the places'
        view rays; levels (n,)."""
        # Far from the first tile, the rounding of uv would count as depth below the surface.
        u, sigma = u - u.floor(), 0.5 * torch.exp2(-level)[:, None]
        aspect = u.new_tensor([1.0, self.lattice.aspect])
        heights, hits = [], []
        along = _azimuth(omega_o)
        across = torch.stack([-along[:, 1], along[:, 0]], 1)
        for x, y in trace.places:
            at = u + sigma * (x * across + y * along) / aspect
            z = self.tracer.trace(at, omega_o)[:, None]
            hits.append(self._displaced(at, z, omega_o))
            heights.append(z)
        depths = torch.cat(heights, 1)
        return depths.mean(1, keepdim=True), torch.cat(hits, 1), depths

    def _displaced(self, u: Tensor, z: Tensor, omega: Tensor) -> Tensor:
        """uv (n, 2) of a ray through `u` at the height 0 where its height is z (n, 1)."""
        return u + z / omega[:, 2:] * omega[:, :2] / u.new_tensor([1.0, self.lattice.aspect])

    def read_maps(self, hit: Tensor, level: Tensor) -> Tensor:
        """All numbers of the maps (n, channels) at surface points (n, 2); levels (n,)."""
        return lookup(self._map_copies.on(hit.device), self.map_table[1], hit, level)

    def about_fibers(
        self, op: FiberFrame, hits: Tensor, level: Tensor, omega_i: Tensor, omega_o: Tensor
    ) -> Tensor:
        """Directions about the fibers (n, 6): means over the intersections (n, 2·places)."""
        table, packing = self._fiber_copies.on(hits.device), self.fiber_table[1]
        maps = (lookup(table, packing, hit, level + op.finer) for hit in hits.split(2, 1))
        return torch.stack([fiber_frame(op, found, omega_i, omega_o) for found in maps]).mean(0)

    def shading(
        self,
        shade: Shade,
        hits: Tensor,
        level: Tensor,
        omega_i: Tensor,
        omega_o: Tensor,
        depths: Tensor | None = None,
    ) -> Tensor:
        """Irradiance, normal (x, y) and core (RGB) (n, 6): means over the intersections (n, 2·places);
        depths: their heights (n, places), which shadow rays need."""
        finer = level + shade.finer
        places = hits.split(2, 1)
        heights = [None] * len(places) if depths is None else depths.split(1, 1)
        parts = [
            self._shade(shade, hit, z, finer, omega_i, omega_o)
            for hit, z in zip(places, heights, strict=True)
        ]
        return torch.stack(parts).mean(0)

    def _shade(
        self, op: Shade, hit: Tensor, z: Tensor | None, level: Tensor, omega_i: Tensor, omega_o: Tensor
    ) -> Tensor:
        """Irradiance, normal and core (n, 6) at surface points."""
        maps = self.read_maps(hit, level)
        center, base = maps[:, :2], maps[:, 5:8]
        spread = doubled_scatter(center, maps[:, 2:5])
        normal = torch.nn.functional.normalize(torch.cat([-center, torch.ones_like(center[:, :1])], 1), dim=1)
        light = self.visibility(op, hit, z, level, omega_i) / omega_i[:, 2:]
        irradiance = light * normal[:, 2:] * shown(omega_i, center, spread)
        core = irradiance * base / math.pi
        if not self.glossy:
            return torch.cat([irradiance, normal[:, :2], core], 1)
        half = torch.nn.functional.normalize(omega_i + omega_o, dim=1)
        rest = schlick((omega_o * half).sum(1, keepdim=True))
        widening = light_widening(omega_i, omega_o, self.light_width)
        # Mean cosines of the facets that the light and the viewer see.
        cosines = tuple(
            (normal[:, 2:] * projections(omega, center, spread)[1]).clamp_max(1.0)
            for omega in (omega_i, omega_o)
        )

        def lobe(alpha2: Tensor, reflectance: Tensor) -> Tensor:
            """(R5) Light (n, 1 or 3) that facets of α² (n, 1) and of a reflectance (n, 1 or 3) reflect."""
            middle, own = own_facets(alpha2, center)
            facets = own + spread
            facing = shown(omega_o, middle, facets).clamp_min(op.least_view)
            density = slope_density(half, middle, facets, widening, alpha2)
            return light * own_shadowing(alpha2, *cosines) * (reflectance * density / (4.0 * facing))

        metallic, own2 = maps[:, 9:10], maps[:, 8:9].clamp(*op.alpha2)
        f0 = torch.lerp(base.new_tensor(self.dielectric), base, metallic)
        grazing = grazing_reflectance(self.dielectric)
        f90 = grazing + metallic * (1.0 - grazing)

        def below(weight: Tensor) -> Tensor:
            """Energy that the dielectric's lobe leaves, by the weight of its grazing reflectance."""
            return 1.0 - self.dielectric - (grazing - self.dielectric) * weight

        # (R9)
        left = math.prod(below(grazing_albedo(own2, x)) for x in cosines) / below(mean_grazing_albedo(own2))
        core = (1.0 - metallic) * left * core + lobe(own2, f0 + (f90 - f0) * rest)
        if self.coated:
            weight, alpha2 = maps[:, 10:11], maps[:, 11:12].clamp(*op.alpha2)
            # (R6)
            for cosine in cosines:
                core = core * (1.0 - coat_reflectance(weight, grazing_albedo(alpha2, cosine)))
            core = core + lobe(alpha2, coat_reflectance(weight, rest))
        return torch.cat([irradiance, normal[:, :2], core], 1)

    def visibility(self, op: Shade, hit: Tensor, z: Tensor | None, level: Tensor, omega_i: Tensor) -> Tensor:
        """Visibility (n, 1) of the light; z (n, 1): heights of the points, None for horizons alone."""
        lower = self._lower_horizons(op, hit, level, omega_i)
        if op.heights is None or z is None:
            return lower
        # (R11)
        first = self.tracer.trace(self._displaced(hit, -z, omega_i), omega_i)[:, None]
        below = (first - z).clamp_min(0.0) / omega_i[:, 2:]
        return 0.5 * (lower + torch.exp(-below / op.light_depth))

    def _lower_horizons(self, op: Shade, hit: Tensor, level: Tensor, omega_i: Tensor) -> Tensor:
        """(R2) Share (n, 1) of the horizons of footprints that are lower than the light."""
        both = lookup(self._horizon_copies.on(hit.device), self.horizon_table[1], hit, level)
        count = both.shape[1] // 2
        # A vertical light has azimuth 0, whatever the signs of its zeros.
        azimuth = torch.atan2(omega_i[:, 1] + 0.0, omega_i[:, 0] + 0.0) * (count / (2.0 * math.pi))
        azimuth = azimuth - count * (azimuth / count).floor()
        first = azimuth.floor().clamp(0, count - 1)
        weight = (azimuth - first)[:, None]
        index = first.long()[:, None]
        after = (index + 1) % count
        mean = torch.lerp(both.gather(1, index), both.gather(1, after), weight)
        square = torch.lerp(both.gather(1, index + count), both.gather(1, after + count), weight)
        variance = (square - mean.square()).clamp_min(0.0) + (op.light_blur * self.light_width) ** 2
        elevation = omega_i[:, 2:].clamp(0.0, 1.0).asin()
        return 0.5 + 0.5 * torch.erf(
            (elevation - mean) / (2.0 * variance.clamp_min(op.least_variance)).sqrt()
        )


def _azimuth(omega: Tensor) -> Tensor:
    """Unit vectors (n, 2) of the azimuths of directions; (1, 0) of vertical ones."""
    length = omega[:, :2].norm(dim=1, keepdim=True)
    return torch.where(length > 0, omega[:, :2] / length, omega.new_tensor([1.0, 0.0]))


def surface_bytes(lattice: Lattice) -> int:
    """Bytes of the surface in a material, besides its heights."""
    finer = Lattice(lattice.finest + 1, lattice.aspect)
    channels = max(COATED_CHANNELS, DIFFUSE_CHANNELS + FIBER_CHANNELS)
    maps = channels * sum(finer.texels(s) for s in range(finer.finest + 1))
    return 4 * (maps + 2 * AZIMUTHS * sum(lattice.texels(s) for s in range(lattice.finest + 1)))


def _map_levels(geometry: Geometry, lattice: Lattice) -> list[Tensor]:
    """Filtered maps (rows, columns, channels) of a geometry for all levels of a lattice."""
    base = geometry.base_color
    if base is None:
        base = np.full((*geometry.slopes.shape[:2], 3), UNKNOWN_COLOR, np.float32)
    if geometry.tangent_moments is not None and geometry.opacity is not None:
        # Gaps between fibers are black.
        base = base * geometry.opacity[..., None]
    rest = [base]
    coat, coat_roughness = geometry.clearcoat, geometry.clearcoat_roughness
    # α = roughness².
    if geometry.roughness is not None and geometry.metallic is not None:
        rest += [geometry.roughness[..., None] ** 4, geometry.metallic[..., None]]
    elif coat is not None:
        # A Lambert surface below the coat: a dielectric of F0 = 0, which has no lobe.
        rest += [np.ones_like(base[..., :1]), np.zeros_like(base[..., :1])]
    if coat is not None and coat_roughness is not None:
        # Where there is little coat, its roughness counts little.
        rest += [coat[..., None], (coat[..., None] + LEAST_COAT) * coat_roughness[..., None] ** 4]
    filtered = prefiltered_levels(torch.from_numpy(np.concatenate(rest, -1)), lattice)
    if coat is not None:
        for level in filtered:
            level[..., -1] = (level[..., -1] / (level[..., -2].clamp_min(0.0) + LEAST_COAT)).clamp(0.0, 1.0)
    return [
        torch.cat(
            [
                slope_distributions(
                    geometry.slopes,
                    geometry.slope_moments,
                    lattice.aspect,
                    lattice.shape(level),
                    lookup_sigma(level, lattice.shape(level)[1]),
                ),
                others,
            ],
            -1,
        )
        for level, others in enumerate(filtered)
    ]


def _take(tensors: Mapping[str, Tensor], name: str, shape: tuple[int | None, ...]) -> Tensor:
    """A tensor of a shape; None stands for any size."""
    tensor = tensors[name]
    if tensor.ndim != len(shape) or any(a not in (None, b) for a, b in zip(shape, tensor.shape, strict=True)):
        raise ValueError(f"'{name}'")
    return tensor.float()


def _packed(levels: tuple[Tensor, ...]) -> tuple[Tensor, Packing]:
    table = torch.cat([level.flatten(0, 1) for level in levels])
    return table, Packing(tuple((level.shape[0], level.shape[1]) for level in levels))
