"""The path tracer: radiance leaving the displaced tile along given rays, one light per ray.

The value of a path is the sum of the effects that are simulated, each in one function:

- :func:`_visible`: parallax and masking, periodic neighbors, holes — or the reference plane without them;
- :func:`_direct`: direct light, next-event estimation, with shadowing where it is simulated;
- :func:`_sky`: what BSDF sampling finds of the light, combined with the former by the balance heuristic
  (Veach 1997);
- interreflection: the loop around them, with Russian roulette, which ends paths without bias.

How a point reflects (specular lobe, metal, coat, normal map) is the surface's business,
:mod:`mbtf_gen.render.bsdf.surface`. An effect that is switched off is not in the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mbtf_gen.render.directional_light import DirectionalLight
from mbtf_gen.render.heightfield_tracer import HeightField, closest_hit, hit_and_shadow, occluded
from mbtf_gen.render.surface_interaction import interaction

# Roulette leaves paths of throughput one alone, for dividing by a survival chance below it makes their
# weights grow without bound in white cracks; only after this many interactions they end with a chance of one
# in two hundred each.
PATIENCE = 64
LATE_SURVIVAL = 0.995
# What comes after the first interaction takes half of the time and brings a tenth of the variance. Paths
# survive with this multiple of their throughput, at most one: on stone, cloth, metal and bark 2 was cheaper
# than 1 and 4.
SURVIVAL_PER_THROUGHPUT = 2.0
# Random numbers are multiples of 2^-24, of which smaller chances would be a coarse approximation.
LEAST_SURVIVAL = 2.0**-10
# Paths along a lobe this narrow (density in 1/sr) may bring all of the light, which light sampling misses:
# roulette waits for them so many interactions more.
NARROW = 4.0
NARROW_WAIT = 2
NO_LIMIT = 0xFFFFFFFF


@dataclass(frozen=True)
class Transport:
    """How paths are followed, and which effects of geometry and light they show.

    Attributes
    ----------
    max_depth : largest number of surface interactions of a path; 0 means no limit
    roulette_depth : interactions before Russian roulette begins
    max_crossings : tile borders that one ray may cross
    displacement : rays meet the displaced tile; otherwise the reference plane, where nothing shadows
    shadowing : light rays are tested for occluders
    interreflection : paths go on after their first interaction
    bsdf_sampling : light is also found by sampling the surface
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
class World:
    """What rays meet: the displaced tile, and how it reflects.

    Attributes
    ----------
    field : the tile's shape, and its size
    surface : reflects; see :mod:`mbtf_gen.render.bsdf.surface`
    """

    field: HeightField
    surface: Any


@dataclass
class Path:
    """State of lanes' paths between two surface interactions: at a place that their last ray met.

    Attributes
    ----------
    p, n : the place, in scene units, and the surface's normal there
    d : direction of the ray that met it
    radiance : found so far
    throughput : weight of what is still to be found
    depth : surface interactions so far
    rng : random numbers, :class:`~mbtf_gen.sampling.sobol.Points`
    capped : rays cut off at the cap on crossings
    lost : rays that went down and met nothing
    passed : the first ray went through the tile
    active : lanes that go on
    """

    p: Any
    n: Any
    d: Any
    radiance: Any
    throughput: Any
    depth: Any
    rng: Any
    capped: Any
    lost: Any
    passed: Any
    active: Any


@dataclass(frozen=True)
class ScatteredRay:
    """Rays on their way to the next place.

    Attributes
    ----------
    ray : the ray
    below : it starts below the surface
    pdf : density with which its direction was chosen; infinite for mirrors and for the first ray
    """

    ray: Any
    below: Any
    pdf: Any


@dataclass(frozen=True)
class Shadow:
    """Rays towards the light, which bring its light unless something is in their way.

    Attributes
    ----------
    ray, below : as of :class:`Onward`
    active : lanes that have such a ray
    radiance : what it brings
    """

    ray: Any
    below: Any
    active: Any
    radiance: Any


def _on_plane(world: World, ray: Any, active: Any) -> Any:
    """Hits of rays on the reference plane."""
    p = ray(-ray.o.z / ray.d.z)
    return interaction(p, mi.Normal3f(0, 0, 1), ray.d, world.field.size, active & (ray.d.z < 0))


def _visible(
    world: World, path: Path, onward: ScatteredRay, shadow: Shadow | None, transport: Transport
) -> tuple[Any, Any]:
    """Parallax and masking, shadowing, periodic neighbors, holes: (what paths' rays meet, lanes that hit the
    cap). Light of shadow rays that meet nothing is added to the paths."""
    holes = world.surface if world.surface.parts.opacity else None
    field, most = world.field, transport.max_crossings
    if shadow is None:
        if not transport.displacement:
            si = _on_plane(world, onward.ray, path.active)
            if holes is not None:
                si.t = dr.select(path.rng.chance() < holes.opacity(si), si.t, dr.inf)
            return si, mi.Bool(False)
        si, _, capped, path.rng = closest_hit(
            field, onward.ray, path.active, most, onward.below, holes, path.rng
        )
        return si, capped
    if holes is None:
        si, capped, blocked, shadow_capped = hit_and_shadow(
            field, onward.ray, path.active, shadow.ray, shadow.active, most, onward.below, shadow.below
        )
        _light_up(path, shadow, blocked, shadow_capped)
        return si, capped
    _shadowed(world, path, shadow, transport)
    return _visible(world, path, onward, None, transport)


def _shadowed(world: World, path: Path, shadow: Shadow, transport: Transport) -> None:
    """Shadowing alone, for paths that end."""
    holes = world.surface if world.surface.parts.opacity else None
    blocked, _, capped, path.rng = occluded(
        world.field, shadow.ray, shadow.active, transport.max_crossings, shadow.below, holes, path.rng
    )
    _light_up(path, shadow, blocked, capped)


def _light_up(path: Path, shadow: Shadow, blocked: Any, capped: Any) -> None:
    path.radiance += dr.select(shadow.active & ~blocked, shadow.radiance, 0.0)
    path.capped[capped] += 1


def _direct(
    world: World, path: Path, si: Any, point: Any, light: DirectionalLight, transport: Transport, begin: Any
) -> Shadow | None:
    """Direct light that a surface point sends along a path, by next-event estimation: where nothing shadows,
    it is added to the path, else it is up to the ray returned."""
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
            density = density + _survival(strongest, path.depth + 1, pdf, begin) * pdf
        incoming = incoming / density
    # Written so that NaN counts as light: it must reach the value, where it is found and drawn again.
    lit = path.active & ~(dr.max(value) <= 0)
    radiance = path.throughput * (value * incoming)
    if transport.shadowing:
        return Shadow(world.field.leave(si, omega), dr.dot(si.n, omega) < 0, lit, radiance)
    path.radiance += dr.select(lit, radiance, 0.0)
    return None


def _sky(
    path: Path, onward: ScatteredRay, light: DirectionalLight, escaped: Any, transport: Transport
) -> Any:
    """Light that BSDF sampling found: what arrives along rays that left the tile upwards."""
    if light.kind == "delta" or not (transport.bsdf_sampling or light.kind == "constant"):
        return mi.Spectrum(0.0)
    d = onward.ray.d
    share = dr.select(dr.isinf(onward.pdf), 1.0, onward.pdf / (onward.pdf + light.sampling_density(d)))
    found = escaped & (path.depth > 0) & (d.z > 0)
    return dr.select(found, path.throughput * (light.radiance(d) * share), 0.0)


def _follow(
    world: World,
    path: Path,
    onward: ScatteredRay,
    shadow: Shadow | None,
    light: DirectionalLight,
    transport: Transport,
    limit: Any,
) -> None:
    """Take paths along their rays to the next place, or to the sky."""
    si, capped = _visible(world, path, onward, shadow, transport)
    path.capped[capped] += 1
    escaped = path.active & ~si.is_valid() & ~capped
    downward = escaped & (onward.ray.d.z <= 0)
    if world.surface.parts.opacity:
        path.passed |= downward & (path.depth == 0)
    else:
        path.lost |= downward
    path.radiance += _sky(path, onward, light, escaped, transport)
    path.active &= si.is_valid() & (path.depth < limit)
    path.p, path.n, path.d = mi.Point3f(si.p), mi.Normal3f(si.n), mi.Vector3f(onward.ray.d)


def _interact(
    world: World, path: Path, light: DirectionalLight, transport: Transport, limit: Any, roulette: Any
) -> tuple[ScatteredRay, Shadow | None]:
    """One surface interaction of every path: where it goes on, and its ray towards the light."""
    si = interaction(path.p, path.n, path.d, world.field.size, path.active)
    point = world.surface.at(si, -path.d)
    shadow = _direct(world, path, si, point, light, transport, roulette)
    path.depth[path.active] += 1
    if not transport.bsdf_sampling and light.kind != "constant":
        path.active &= path.depth < limit
    omega, weight, pdf = point.sample(path.rng.next_1d(), path.rng.next_2d())
    path.throughput *= weight
    pdf = pdf * _roulette(path, pdf, roulette)
    return ScatteredRay(world.field.leave(si, omega), dr.dot(si.n, omega) < 0, pdf), shadow


def _survival(strongest: Any, depth: Any, pdf: Any, begin: Any) -> Any:
    """Chance that roulette lets a path of a throughput go on in a direction of a density.

    The balance heuristic counts with it on both sides: otherwise light that surface sampling was to find
    would hang, on dark surfaces, on the few paths that survive, with great weights.
    """
    longest = dr.select(depth < PATIENCE, 1.0, LATE_SURVIVAL)
    likely = dr.clip(SURVIVAL_PER_THROUGHPUT * strongest, LEAST_SURVIVAL, longest)
    begin = dr.select(pdf > NARROW, begin + NARROW_WAIT, begin)
    return dr.select(depth >= begin, likely, 1.0)


def _roulette(path: Path, pdf: Any, begin: Any) -> Any:
    """End paths by chance; returns the chances of those that go on."""
    strongest = dr.max(path.throughput)
    # A path of NaN throughput would end here as if it were black.
    path.radiance[path.active & dr.isnan(strongest)] = mi.Spectrum(dr.nan)
    path.active &= strongest > 0
    survival = _survival(strongest, path.depth, pdf, begin)
    path.active &= path.rng.next_1d() < survival
    path.throughput *= dr.rcp(survival)
    return survival


def trace(
    world: World,
    ray: Any,
    light: DirectionalLight,
    transport: Transport,
    limit: Any,
    roulette: Any,
    rng: Any,
    active: Any,
) -> Path:
    """Follow paths to their ends.

    All lanes take the first interaction side by side, in one kernel without a loop over paths; those that
    meet the surface again are gathered and go on in a second one. Otherwise most lanes would idle beside a
    few long paths.

    Parameters
    ----------
    limit, roulette : largest number of surface interactions of a path, and those before roulette begins;
        opaque, so that they are not part of the kernel

    Returns
    -------
    The paths' last state: ``radiance`` towards the rays' origins, ``passed``, and what was ``lost`` or
    ``capped``
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
        # Only surface sampling finds this light: the first ray that may is not left to chance.
        roulette = roulette + 1
    first = ScatteredRay(ray, mi.Bool(False), mi.Float(dr.inf))
    _follow(world, path, first, None, light, transport, limit)
    onward, shadow = _interact(world, path, light, transport, limit, roulette)
    if not (transport.interreflection or transport.bsdf_sampling or light.kind == "constant"):
        if shadow is not None:
            _shadowed(world, path, shadow, transport)
        return path
    _follow(world, path, onward, shadow, light, transport, limit)
    if not transport.interreflection:
        return path
    # Lights too: the second kernel reads those of its lanes.
    dr.eval(path, light)
    going = dr.compress(path.active)
    if len(going):
        rest = _picked(path, going)
        rest.radiance, rest.capped, rest.lost = mi.Spectrum(0.0), mi.UInt32(0), mi.Bool(False)
        rest = _loop(world, rest, _picked(light, going), transport, limit, roulette)
        dr.eval(rest.radiance, rest.capped, rest.lost)
        path.radiance += _spread(rest.radiance, going, dr.width(path.active))
        path.capped += _spread(rest.capped, going, dr.width(path.active))
        path.lost |= _spread(rest.lost, going, dr.width(path.active))
    return path


def _picked(state: Any, lanes: Any) -> Any:
    """Some lanes of a dataclass of arrays; what is no array stays as it is."""

    def pick(value: Any) -> Any:
        if is_dataclass(value):
            return _picked(value, lanes)
        if not dr.is_array_v(value) or dr.width(value) == 1:
            return value
        return dr.gather(type(value), value, lanes)

    return replace(state, **{f.name: pick(getattr(state, f.name)) for f in fields(state)})


def _spread(values: Any, lanes: Any, width: int) -> Any:
    """Values of some lanes among zeros."""
    out = dr.zeros(type(values), width)
    dr.scatter(out, values, lanes)
    return out


@dr.syntax
def _loop(
    world: World, path: Path, light: DirectionalLight, transport: Transport, limit: Any, roulette: Any
) -> Path:
    """Follow paths that stand on the surface to their ends."""
    while dr.hint(path.active, exclude=[world, light, transport, limit, roulette]):
        onward, shadow = _interact(world, path, light, transport, limit, roulette)
        _follow(world, path, onward, shadow, light, transport, limit)
    return path
