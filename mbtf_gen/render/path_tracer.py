"""The path tracer: radiance that leaves the displaced tile along given rays, one light per ray.

The value of a path is the sum of the simulated effects, each in one method of :class:`PathTracer`:

- ``_visible``: parallax, periodicity and opacity masks, or the reference plane without them;
- ``_direct``: direct light by next-event estimation, with shadowing where it is simulated;
- ``_escaped``: light found by BSDF sampling, weighted against next-event estimation by the balance
  heuristic (Veach 1997, "Robust Monte Carlo Methods for Light Transport Simulation", section 9.2);
- interreflection: the loop around them, with Russian roulette: paths end at random, without bias, where
  little throughput is left (Arvo and Kirk 1990, "Particle Transport and Image Synthesis").

Reflection at a point (diffuse and specular lobes, clear coat, sheen, normal map) is in
:mod:`mbtf_gen.render.bsdf.surface`. An effect that is switched off is not compiled into the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.engine.types import (
    Float,
    Mask,
    Ray3f,
    Spectrum,
    SurfaceInteraction3f,
    UInt32,
    Vector3f,
)
from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.scene import TileScene
from mbtf_gen.sampling.sobol import SobolSampler
from mbtf_gen.tile.tracers.protocol import Vertex

NO_LIMIT = 0xFFFFFFFF

# Paths of throughput one always survive up to this many interactions: in white cracks, dividing by smaller
# survival probabilities would let their weights grow without bound. Later they survive with LATE_SURVIVAL.
LATE_DEPTH = 64
LATE_SURVIVAL = 0.995
# Survival probability over throughput. Interactions after the first take half of the time and contribute a
# tenth of the variance; on stone, cloth, metal and bark, 2 was cheaper than 1 and 4.
SURVIVAL_PER_THROUGHPUT = 2.0
# Random numbers are multiples of 2^-24, which approximate smaller probabilities coarsely.
LEAST_SURVIVAL = 2.0**-10
# A path sampled from a lobe at least this narrow (density in 1/sr) may carry light that light sampling
# misses: Russian roulette starts this many interactions later.
NARROW_PDF = 4.0
NARROW_EXTRA_DEPTH = 2


@dataclass(frozen=True)
class Transport:
    """Light transport: which effects of geometry and light are simulated, and where paths end.

    Attributes
    ----------
    max_depth : largest number of surface interactions of a path; 0 means no limit
    roulette_depth : interactions before Russian roulette starts
    max_crossings : tile borders that one ray may cross
    displacement : rays intersect the displaced tile; otherwise the reference plane, which has no shadows and
        no interreflection: both must be off
    shadowing : shadow rays are tested for occlusion
    interreflection : paths continue after their first interaction
    bsdf_sampling : light is also found by sampling the BSDF
    """

    max_depth: int = 0
    roulette_depth: int = 1
    max_crossings: int = 4096
    displacement: bool = True
    shadowing: bool = True
    interreflection: bool = True
    bsdf_sampling: bool = True

    @property
    def limit(self) -> int:
        """Largest number of surface interactions of a path."""
        return (self.max_depth or NO_LIMIT) if self.interreflection else 1


@dataclass
class Path:
    """State of paths between two surface interactions, one path per lane.

    Attributes
    ----------
    vertex : the current vertex; None before the first
    d : direction of the ray that arrived there
    radiance : accumulated so far
    throughput : product of the BSDF weights so far
    depth : surface interactions so far
    rng : state of the random numbers
    capped : number of rays that reached the cap on crossings
    lost : rays that went down and hit nothing
    passed : the first ray was transmitted, by the opacity mask or between fibers
    active : lanes that continue
    """

    vertex: Vertex | None
    d: Vector3f
    radiance: Spectrum
    throughput: Spectrum
    depth: UInt32
    rng: SobolSampler
    capped: UInt32
    lost: Mask
    passed: Mask
    active: Mask


@dataclass(frozen=True)
class ScatteredRay:
    """Rays from the current vertex to the next.

    Attributes
    ----------
    ray : the ray
    below : lanes whose ray starts below the surface
    pdf : density of its direction in 1/sr; infinite for mirrors and for the first ray
    """

    ray: Ray3f
    below: Mask
    pdf: Float


@dataclass(frozen=True)
class Shadow:
    """Shadow rays of next-event estimation.

    Attributes
    ----------
    ray, below : as of :class:`ScatteredRay`
    active : lanes that have a shadow ray
    radiance : contribution to the path if the ray is not occluded
    """

    ray: Ray3f
    below: Mask
    active: Mask
    radiance: Spectrum


@dataclass(frozen=True)
class PathTracer:
    """Traces paths on one tile.

    Attributes
    ----------
    tile : geometry and reflection
    transport : effects that are simulated
    light : the light of each lane
    limit, roulette : largest number of surface interactions of a path, and interactions before Russian
        roulette starts; opaque and of width 1, so that different numbers share the compiled kernel
    """

    tile: TileScene
    transport: Transport
    light: DirectionalLight
    limit: UInt32
    roulette: UInt32

    @property
    def _holes(self) -> Any:
        """The surface where it has an opacity mask, otherwise None."""
        return self.tile.surface if self.tile.surface.parts.opacity else None

    @property
    def _open(self) -> bool:
        """Whether rays may leave the tile downward."""
        return self.tile.geometry.open or self._holes is not None

    @property
    def _of_lanes(self) -> Any:
        """What of the tracer differs between lanes."""
        return self.light

    def _compacted(self, lanes: UInt32) -> PathTracer:
        """The tracer of some of the lanes."""
        return replace(self, light=_gather_lanes(self.light, lanes))

    @property
    def _bsdf_sampling(self) -> bool:
        """Whether light is also found by sampling the BSDF, which alone finds constant light."""
        return self.transport.bsdf_sampling or self.light.kind == "constant"

    def trace(self, ray: Ray3f, rng: SobolSampler) -> Path:
        """Trace paths to their ends.

        The first interaction of all lanes is one kernel without a loop over paths. Paths that hit the surface
        again are compacted and continue in a second kernel; otherwise most lanes would idle beside a few long
        paths.

        Returns
        -------
        Path
            Final state: ``radiance`` towards the rays' origins in 1/sr for unit irradiance, ``passed``, and
            the counts ``lost`` and ``capped``.
        """
        path = Path(
            vertex=None,
            d=mi.Vector3f(0.0, 0.0, -1.0),
            radiance=mi.Spectrum(0.0),
            throughput=mi.Spectrum(1.0),
            depth=mi.UInt32(0),
            rng=rng,
            capped=mi.UInt32(0),
            lost=mi.Bool(False),
            passed=mi.Bool(False),
            active=mi.Bool(True),
        )
        # The first ray that can find constant light always survives.
        tracer = replace(self, roulette=self.roulette + 1) if self.light.kind == "constant" else self
        return tracer._trace(path, ScatteredRay(ray, mi.Bool(False), mi.Float(dr.inf)))

    def _trace(self, path: Path, first: ScatteredRay) -> Path:
        self._follow(path, first, None)
        scattered, shadow = self._interact(path)
        if not (self.transport.interreflection or self._bsdf_sampling):
            if shadow is not None:
                self._trace_shadow(path, shadow)
            return path
        self._follow(path, scattered, shadow)
        if not self.transport.interreflection:
            return path
        # The lights as well: the second kernel gathers those of its lanes.
        dr.eval(path, self._of_lanes)
        lanes = dr.compress(path.active)
        if len(lanes):
            rest = _gather_lanes(path, lanes)
            rest.radiance, rest.capped, rest.lost = mi.Spectrum(0.0), mi.UInt32(0), mi.Bool(False)
            rest = self._compacted(lanes)._loop(rest)
            dr.eval(rest.radiance, rest.capped, rest.lost)

            def scattered_back(values: Any) -> Any:
                out = dr.zeros(type(values), dr.width(path.active))
                dr.scatter(out, values, lanes)
                return out

            path.radiance += scattered_back(rest.radiance)
            path.capped += scattered_back(rest.capped)
            path.lost |= scattered_back(rest.lost)
        return path

    @dr.syntax
    def _loop(self, path: Path) -> Path:
        """Trace paths from a vertex to their ends."""
        while dr.hint(path.active, exclude=[self]):
            scattered, shadow = self._interact(path)
            self._follow(path, scattered, shadow)
        return path

    def _follow(self, path: Path, scattered: ScatteredRay, shadow: Shadow | None) -> None:
        """Trace paths along their rays to the next vertex, or to the light."""
        si, capped = self._visible(path, scattered, shadow)
        path.capped[capped] += 1
        escaped = path.active & ~si.is_valid() & ~capped
        downward = escaped & (scattered.ray.d.z <= 0)
        if self._open:
            path.passed |= downward & (path.depth == 0)
        else:
            path.lost |= downward
        path.radiance += self._escaped(path, scattered, escaped)
        path.active &= si.is_valid() & (path.depth < self.limit)
        path.vertex, path.d = self.tile.geometry.vertex(si), mi.Vector3f(scattered.ray.d)

    def _visible(
        self, path: Path, scattered: ScatteredRay, shadow: Shadow | None
    ) -> tuple[SurfaceInteraction3f, Mask]:
        """Parallax, shadowing, periodicity, opacity masks: (hits of the paths' rays, lanes that reached the
        cap). Contributions of shadow rays that are not occluded are added to the paths."""
        geometry, holes, most = self.tile.geometry, self._holes, self.transport.max_crossings
        ray, below = scattered.ray, scattered.below
        if shadow is not None and holes is None:
            si, capped, blocked, shadow_capped = geometry.hit_and_shadow(
                ray, path.active, shadow.ray, shadow.active, most, below, shadow.below
            )
            _add_unoccluded(path, shadow, blocked, shadow_capped)
            return si, capped
        if shadow is not None:
            self._trace_shadow(path, shadow)
        if self.transport.displacement:
            si, _, capped, path.rng = geometry.closest_hit(ray, path.active, most, below, holes, path.rng)
            return si, capped
        plane = Vertex(ray(-ray.o.z / ray.d.z), mi.Normal3f(0, 0, 1))
        si = geometry.interaction(plane, ray.d, path.active & (ray.d.z < 0))
        if holes is not None:
            si.t = dr.select(path.rng.chance() < holes.opacity(si), si.t, dr.inf)
        return si, mi.Bool(False)

    def _trace_shadow(self, path: Path, shadow: Shadow) -> None:
        """Shadowing alone, for paths that end."""
        blocked, _, capped, path.rng = self.tile.geometry.occluded(
            shadow.ray,
            shadow.active,
            self.transport.max_crossings,
            shadow.below,
            self._holes,
            path.rng,
        )
        _add_unoccluded(path, shadow, blocked, capped)

    def _interact(self, path: Path) -> tuple[ScatteredRay, Shadow | None]:
        """One surface interaction of every path: its scattered ray and its shadow ray."""
        geometry = self.tile.geometry
        assert path.vertex is not None
        si = geometry.interaction(path.vertex, path.d, path.active)
        point = self.tile.surface.at(si, -path.d)
        shadow = self._direct(path, si, point)
        path.depth[path.active] += 1
        if not self._bsdf_sampling:
            path.active &= path.depth < self.limit
        omega, weight, pdf = point.sample(path.rng.next_1d(), path.rng.next_2d())
        path.throughput *= weight
        pdf = pdf * _russian_roulette(path, pdf, self.roulette)
        return ScatteredRay(geometry.leave(si, omega), dr.dot(si.n, omega) < 0, pdf), shadow

    def _direct(self, path: Path, si: SurfaceInteraction3f, point: Any) -> Shadow | None:
        """Direct light reflected at a vertex, by next-event estimation. Without shadowing it is added to the
        path, otherwise the shadow ray returned decides."""
        light = self.light
        if light.kind == "constant":
            return None
        if light.kind == "delta":
            omega, incoming = light.omega_i, light.inverse_irradiance
        else:
            omega = light.sample(path.rng.next_2d())
            incoming = light.radiance(omega)
        value, pdf = point.eval_pdf(omega)
        if light.kind == "lobe":
            density = light.sampling_density(omega)
            if self._bsdf_sampling:
                strongest = dr.max(path.throughput * value) / dr.maximum(pdf, 1e-30)
                survival = survival_probability(strongest, path.depth + 1, pdf, self.roulette)
                density = density + survival * pdf
            incoming = incoming / density
        # NaN counts as light: it must reach the value, where the sample is detected and drawn again.
        lit = path.active & ~(dr.max(value) <= 0)
        radiance = path.throughput * (value * incoming)
        if self.transport.shadowing:
            return Shadow(self.tile.geometry.leave(si, omega), dr.dot(si.n, omega) < 0, lit, radiance)
        path.radiance += dr.select(lit, radiance, 0.0)
        return None

    def _escaped(self, path: Path, scattered: ScatteredRay, escaped: Mask) -> Spectrum:
        """Light found by BSDF sampling: radiance along rays that left the tile."""
        light = self.light
        if light.kind == "delta" or not self._bsdf_sampling:
            return mi.Spectrum(0.0)
        d, pdf = scattered.ray.d, scattered.pdf
        share = dr.select(dr.isinf(pdf), 1.0, pdf / (pdf + light.sampling_density(d)))
        found = escaped & (path.depth > 0)
        if light.kind != "constant" or not self._open:
            found &= d.z > 0
        return dr.select(found, path.throughput * (light.radiance(d) * share), 0.0)


def _add_unoccluded(path: Path, shadow: Shadow, blocked: Mask, capped: Mask) -> None:
    path.radiance += dr.select(shadow.active & ~blocked, shadow.radiance, 0.0)
    path.capped[capped] += 1


def survival_probability(strongest: Float, depth: UInt32, pdf: Float, start: UInt32) -> Float:
    """Survival probability of Russian roulette, from the largest channel of the throughput.

    Both densities of the balance heuristic include it. Otherwise, on dark surfaces, light found by BSDF
    sampling would be carried by the few paths that survive, with large weights.
    """
    largest = dr.select(depth < LATE_DEPTH, 1.0, LATE_SURVIVAL)
    likely = dr.clip(SURVIVAL_PER_THROUGHPUT * strongest, LEAST_SURVIVAL, largest)
    start = dr.select(pdf > NARROW_PDF, start + NARROW_EXTRA_DEPTH, start)
    return dr.select(depth >= start, likely, 1.0)


def _russian_roulette(path: Path, pdf: Float, start: UInt32) -> Float:
    """End paths at random; returns the survival probabilities."""
    strongest = dr.max(path.throughput)
    # A path of NaN throughput would end here as if it were black.
    path.radiance[path.active & dr.isnan(strongest)] = mi.Spectrum(dr.nan)
    path.active &= strongest > 0
    survival = survival_probability(strongest, path.depth, pdf, start)
    path.active &= path.rng.next_1d() < survival
    path.throughput *= dr.rcp(survival)
    return survival


def _gather_lanes(state: Any, lanes: UInt32) -> Any:
    """Some lanes of a dataclass of arrays; other attributes are unchanged."""

    def pick(value: Any) -> Any:
        if is_dataclass(value):
            return _gather_lanes(value, lanes)
        if not dr.is_array_v(value) or dr.width(value) == 1:
            return value
        return dr.gather(type(value), value, lanes)

    return replace(state, **{f.name: pick(getattr(state, f.name)) for f in fields(state)})
