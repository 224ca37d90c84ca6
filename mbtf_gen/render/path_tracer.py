"""The path tracer: radiance that leaves the displaced tile along given rays, one light per ray.

The value of a path is the sum of the simulated effects, each in one function:

- :func:`_visible`: parallax, periodicity and opacity masks, or the reference plane without them;
- :func:`_direct`: direct light by next-event estimation, with shadowing where it is simulated;
- :func:`_escaped`: light found by BSDF sampling, weighted against next-event estimation by the balance
  heuristic (Veach 1997, "Robust Monte Carlo Methods for Light Transport Simulation", section 9.2);
- interreflection: the loop around them, with Russian roulette, which ends paths without bias.

Reflection at a point (diffuse and specular lobes, clear coat, sheen, normal map) is in
:mod:`mbtf_gen.render.bsdf.surface`. An effect that is switched off is not compiled into the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.heightfield import HeightField
from mbtf_gen.render.heightfield_tracer import closest_hit, hit_and_shadow, occluded
from mbtf_gen.render.russian_roulette import survival_probability
from mbtf_gen.render.surface_interaction import interaction
from mbtf_gen.render.types import (
    Float,
    Mask,
    Normal3f,
    Point3f,
    Ray3f,
    Spectrum,
    SurfaceInteraction3f,
    UInt32,
    Vector3f,
)
from mbtf_gen.sampling.sobol import SobolSampler

NO_LIMIT = 0xFFFFFFFF


@dataclass(frozen=True)
class Transport:
    """Light transport: which effects of geometry and light are simulated, and where paths end.

    Parameters
    ----------
    max_depth : int
        Largest number of surface interactions of a path; 0 means no limit.
    roulette_depth : int
        Interactions before Russian roulette starts.
    max_crossings : int
        Tile borders that one ray may cross.
    displacement : bool
        Rays intersect the displaced tile; otherwise the reference plane, which has no shadows.
    shadowing : bool
        Shadow rays are tested for occlusion.
    interreflection : bool
        Paths continue after their first interaction.
    bsdf_sampling : bool
        Light is also found by sampling the BSDF.

    Raises
    ------
    ValueError
        A plane is to have shadows or interreflection.
    """

    max_depth: int = 0
    roulette_depth: int = 1
    max_crossings: int = 4096
    displacement: bool = True
    shadowing: bool = True
    interreflection: bool = True
    bsdf_sampling: bool = True

    def __post_init__(self) -> None:
        if not self.displacement and (self.shadowing or self.interreflection):
            raise ValueError("a plane has no shadows and no interreflection")

    @property
    def limit(self) -> int:
        """Largest number of surface interactions of a path."""
        if not self.interreflection:
            return 1
        return self.max_depth or NO_LIMIT


PLANE = Transport(displacement=False, shadowing=False, interreflection=False)


@dataclass(frozen=True)
class TraceOptions:
    """Options of one estimate, which share the compiled kernel.

    Attributes
    ----------
    limit : UInt32
        Largest number of surface interactions of a path; opaque, of width 1.
    roulette : UInt32
        Interactions before Russian roulette starts; opaque, of width 1.
    path_variance : bool
        The sample variance of single paths is estimated as well.
    """

    limit: UInt32
    roulette: UInt32
    path_variance: bool = False


@dataclass(frozen=True)
class World:
    """The scene: the displaced tile and its reflection.

    Attributes
    ----------
    heightfield : HeightField
        Geometry of the tile.
    surface : Surface or MitsubaSurface
        Reflection, see :mod:`mbtf_gen.render.bsdf.surface`.
    """

    heightfield: HeightField
    surface: Any


@dataclass
class Path:
    """State of paths between two surface interactions, one path per lane.

    Attributes
    ----------
    p, n : position of the current vertex in scene units, and the geometric normal there
    d : direction of the ray that arrived there
    radiance : accumulated so far
    throughput : product of the BSDF weights so far
    depth : surface interactions so far
    rng : state of the random numbers
    capped : number of rays that reached the cap on crossings
    lost : rays that went down and hit nothing
    passed : the first ray was transmitted by the opacity mask
    active : lanes that continue
    """

    p: Point3f
    n: Normal3f
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


def _on_plane(world: World, ray: Ray3f, active: Mask) -> SurfaceInteraction3f:
    """Intersections of rays with the reference plane."""
    p = ray(-ray.o.z / ray.d.z)
    return interaction(p, mi.Normal3f(0, 0, 1), ray.d, world.heightfield.size, active & (ray.d.z < 0))


def _visible(
    world: World, path: Path, scattered: ScatteredRay, shadow: Shadow | None, transport: Transport
) -> tuple[SurfaceInteraction3f, Mask]:
    """Parallax, shadowing, periodicity, opacity masks: (hits of the paths' rays, lanes that reached the cap).
    Contributions of shadow rays that are not occluded are added to the paths."""
    holes = world.surface if world.surface.parts.opacity else None
    heightfield, most = world.heightfield, transport.max_crossings
    if shadow is None:
        if not transport.displacement:
            si = _on_plane(world, scattered.ray, path.active)
            if holes is not None:
                si.t = dr.select(path.rng.chance() < holes.opacity(si), si.t, dr.inf)
            return si, mi.Bool(False)
        si, _, capped, path.rng = closest_hit(
            heightfield, scattered.ray, path.active, most, scattered.below, holes, path.rng
        )
        return si, capped
    if holes is None:
        si, capped, blocked, shadow_capped = hit_and_shadow(
            heightfield,
            scattered.ray,
            path.active,
            shadow.ray,
            shadow.active,
            most,
            scattered.below,
            shadow.below,
        )
        _add_unoccluded(path, shadow, blocked, shadow_capped)
        return si, capped
    _trace_shadow(world, path, shadow, transport)
    return _visible(world, path, scattered, None, transport)


def _trace_shadow(world: World, path: Path, shadow: Shadow, transport: Transport) -> None:
    """Shadowing alone, for paths that end."""
    holes = world.surface if world.surface.parts.opacity else None
    blocked, _, capped, path.rng = occluded(
        world.heightfield, shadow.ray, shadow.active, transport.max_crossings, shadow.below, holes, path.rng
    )
    _add_unoccluded(path, shadow, blocked, capped)


def _add_unoccluded(path: Path, shadow: Shadow, blocked: Mask, capped: Mask) -> None:
    path.radiance += dr.select(shadow.active & ~blocked, shadow.radiance, 0.0)
    path.capped[capped] += 1


def _direct(
    world: World,
    path: Path,
    si: SurfaceInteraction3f,
    point: Any,
    light: DirectionalLight,
    transport: Transport,
    options: TraceOptions,
) -> Shadow | None:
    """Direct light reflected at a vertex, by next-event estimation. Without shadowing it is added to the
    path, otherwise the shadow ray returned decides."""
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
        if transport.bsdf_sampling:
            strongest = dr.max(path.throughput * value) / dr.maximum(pdf, 1e-30)
            density = density + survival_probability(strongest, path.depth + 1, pdf, options.roulette) * pdf
        incoming = incoming / density
    # NaN counts as light: it must reach the value, where the sample is detected and drawn again.
    lit = path.active & ~(dr.max(value) <= 0)
    radiance = path.throughput * (value * incoming)
    if transport.shadowing:
        return Shadow(world.heightfield.leave(si, omega), dr.dot(si.n, omega) < 0, lit, radiance)
    path.radiance += dr.select(lit, radiance, 0.0)
    return None


def _escaped(
    path: Path, scattered: ScatteredRay, light: DirectionalLight, escaped: Mask, transport: Transport
) -> Spectrum:
    """Light found by BSDF sampling: radiance along rays that left the tile upwards."""
    if light.kind == "delta" or not (transport.bsdf_sampling or light.kind == "constant"):
        return mi.Spectrum(0.0)
    d, pdf = scattered.ray.d, scattered.pdf
    share = dr.select(dr.isinf(pdf), 1.0, pdf / (pdf + light.sampling_density(d)))
    found = escaped & (path.depth > 0) & (d.z > 0)
    return dr.select(found, path.throughput * (light.radiance(d) * share), 0.0)


def _follow(
    world: World,
    path: Path,
    scattered: ScatteredRay,
    shadow: Shadow | None,
    light: DirectionalLight,
    transport: Transport,
    options: TraceOptions,
) -> None:
    """Trace paths along their rays to the next vertex, or to the light."""
    si, capped = _visible(world, path, scattered, shadow, transport)
    path.capped[capped] += 1
    escaped = path.active & ~si.is_valid() & ~capped
    downward = escaped & (scattered.ray.d.z <= 0)
    if world.surface.parts.opacity:
        path.passed |= downward & (path.depth == 0)
    else:
        path.lost |= downward
    path.radiance += _escaped(path, scattered, light, escaped, transport)
    path.active &= si.is_valid() & (path.depth < options.limit)
    path.p, path.n, path.d = mi.Point3f(si.p), mi.Normal3f(si.n), mi.Vector3f(scattered.ray.d)


def _interact(
    world: World, path: Path, light: DirectionalLight, transport: Transport, options: TraceOptions
) -> tuple[ScatteredRay, Shadow | None]:
    """One surface interaction of every path: its scattered ray and its shadow ray."""
    si = interaction(path.p, path.n, path.d, world.heightfield.size, path.active)
    point = world.surface.at(si, -path.d)
    shadow = _direct(world, path, si, point, light, transport, options)
    path.depth[path.active] += 1
    if not transport.bsdf_sampling and light.kind != "constant":
        path.active &= path.depth < options.limit
    omega, weight, pdf = point.sample(path.rng.next_1d(), path.rng.next_2d())
    path.throughput *= weight
    pdf = pdf * _russian_roulette(path, pdf, options.roulette)
    return ScatteredRay(world.heightfield.leave(si, omega), dr.dot(si.n, omega) < 0, pdf), shadow


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


def trace(
    world: World,
    ray: Ray3f,
    light: DirectionalLight,
    transport: Transport,
    options: TraceOptions,
    rng: SobolSampler,
    active: Mask,
) -> Path:
    """Trace paths to their ends.

    The first interaction of all lanes is one kernel without a loop over paths. Paths that hit the surface
    again are compacted and continue in a second kernel; otherwise most lanes would idle beside a few long
    paths.

    Parameters
    ----------
    world : World
        The tile and its reflection.
    ray : Ray3f
        First rays, in scene units.
    light : DirectionalLight
        The light of each lane.
    transport : Transport
        Effects that are simulated.
    options : TraceOptions
        Limit of the depth, and start of Russian roulette.
    rng : SobolSampler
        Random numbers, one sequence per lane.
    active : Mask
        Lanes to trace.

    Returns
    -------
    Path
        Final state: ``radiance`` towards the rays' origins in 1/sr for unit irradiance, ``passed``, and the
        counts ``lost`` and ``capped``.
    """
    path = Path(
        mi.Point3f(0.0),
        mi.Normal3f(0.0, 0.0, 1.0),
        mi.Vector3f(0.0, 0.0, -1.0),
        mi.Spectrum(0.0),
        mi.Spectrum(1.0),
        mi.UInt32(0),
        rng,
        mi.UInt32(0),
        mi.Bool(False),
        mi.Bool(False),
        mi.Bool(active),
    )
    if light.kind == "constant":
        # BSDF sampling alone finds this light: the first ray that can always survives.
        options = replace(options, roulette=options.roulette + 1)
    first = ScatteredRay(ray, mi.Bool(False), mi.Float(dr.inf))
    _follow(world, path, first, None, light, transport, options)
    scattered, shadow = _interact(world, path, light, transport, options)
    if not (transport.interreflection or transport.bsdf_sampling or light.kind == "constant"):
        if shadow is not None:
            _trace_shadow(world, path, shadow, transport)
        return path
    _follow(world, path, scattered, shadow, light, transport, options)
    if not transport.interreflection:
        return path
    # The lights as well: the second kernel gathers those of its lanes.
    dr.eval(path, light)
    active_lanes = dr.compress(path.active)
    if len(active_lanes):
        rest = _gather_lanes(path, active_lanes)
        rest.radiance, rest.capped, rest.lost = mi.Spectrum(0.0), mi.UInt32(0), mi.Bool(False)
        rest = _loop(world, rest, _gather_lanes(light, active_lanes), transport, options)
        dr.eval(rest.radiance, rest.capped, rest.lost)
        path.radiance += _scatter_lanes(rest.radiance, active_lanes, dr.width(path.active))
        path.capped += _scatter_lanes(rest.capped, active_lanes, dr.width(path.active))
        path.lost |= _scatter_lanes(rest.lost, active_lanes, dr.width(path.active))
    return path


def _gather_lanes(state: Any, lanes: UInt32) -> Any:
    """Some lanes of a dataclass of arrays; other attributes are unchanged."""

    def pick(value: Any) -> Any:
        if is_dataclass(value):
            return _gather_lanes(value, lanes)
        if not dr.is_array_v(value) or dr.width(value) == 1:
            return value
        return dr.gather(type(value), value, lanes)

    return replace(state, **{f.name: pick(getattr(state, f.name)) for f in fields(state)})


def _scatter_lanes(values: Any, lanes: UInt32, width: int) -> Any:
    """Values scattered to some lanes, zero in the others."""
    out = dr.zeros(type(values), width)
    dr.scatter(out, values, lanes)
    return out


@dr.syntax
def _loop(
    world: World, path: Path, light: DirectionalLight, transport: Transport, options: TraceOptions
) -> Path:
    """Trace paths from a vertex to their ends."""
    while dr.hint(path.active, exclude=[world, light, transport, options]):
        scattered, shadow = _interact(world, path, light, transport, options)
        _follow(world, path, scattered, shadow, light, transport, options)
    return path
