"""Decides the effects plan: looks at heights and maps, and at a small pilot where theory gives no bound."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mbtf_core.errors import UsageError
from mbtf_gen.config.effects_request import EFFECTS, OF_RELIEF, EffectsRequest
from mbtf_gen.images.resample import resample
from mbtf_gen.planning.bounds import POINTS, ReliefBounds, largest_slope, relief_bounds
from mbtf_gen.planning.effects import Effect, EffectsPlan, decide
from mbtf_gen.planning.pilot import Pilot, pilot_queries
from mbtf_gen.sampling.light_kernel import LightKernel

if TYPE_CHECKING:
    from mbtf_gen.generation import Job
    from mbtf_gen.material.loader import Share
    from mbtf_gen.material.material import Material

# Standard deviations of the light lobe beyond which nothing of it is looked for, and the share of a Gaussian
# that lies beyond them on one side.
LOBE_TAIL = 3.5
LOBE_TAIL_SHARE = 2.4e-4
# Light found by next-event estimation alone keeps its variance when the narrowest lobe of the surface, about
# 2α wide, is so many times wider than the light's.
WIDER = 4.0
# Runs of fewer paths are done before a pilot has paid for itself.
SMALL_RUN = 10_000_000
# Deepest cap on surface interactions that is tried.
DEEPEST_CAP = 4
# A gloss, coat or sheen of less strength may be too faint to matter, and is looked at.
FAINT = 0.05
# Layers that may be faint: the factor from their values to their strength. A specular of 1/4, F0 = 2 %, is
# the first that reflects everything at grazing angles.
LAYERS = {"specular": 4.0, "metallic": math.inf, "coat": 1.0, "sheen": 1.0}
# What a faint layer costs, over the share of a full one's cost that its strength says: both are equal but for
# light that meets the layer more than once.
FAINT_CAUTION = 2.0


@dataclass(frozen=True)
class _Look:
    """What the decisions are made from."""

    job: Job
    albedo: NDArray[np.float64]
    lambert: bool
    own_bsdf: bool
    pilots: bool

    @cached_property
    def steepest(self) -> float:
        """Largest slope of the mesh."""
        return largest_slope(self.job.grid)

    @property
    def lowest_light(self) -> float:
        """Elevation in radians below which the light is not looked for; ≤ 0 where there is no such bound."""
        config = self.job.config
        return float(np.arcsin(config.queries.min_cos) - LOBE_TAIL * np.radians(config.light.width))

    @property
    def below_lowest(self) -> float:
        """Share of the light below it, at most."""
        return LOBE_TAIL_SHARE if self.job.config.light.width > 0 else 0.0


def plan_effects(job: Job, *, pilots: bool = True) -> EffectsPlan:
    """Effects plan of a run.

    Parameters
    ----------
    pilots : measure where theory gives no bound; otherwise such effects stay on

    Raises
    ------
    UsageError : an effect was asked for that the material does not have, or that needs one asked away
    """
    wish = EffectsRequest.parse(job.config.effects.mode)
    look = _look(job, pilots)
    tolerance = job.config.effects.tolerance
    reflecting = _surface(look, [n for n in LAYERS if wish.base == "auto" and n not in wish.forced])
    decided = {e.name: decide(wish, e) for e in _affordable(reflecting, tolerance)}
    left = tolerance - sum(e.cost or 0.0 for e in decided.values() if not e.on)
    if not any(e.on for e in decided.values()):
        look = replace(look, lambert=True)
    costs = _relief(look)
    others = _affordable([_normal(look, costs), _opacity(look, costs), _fibers()], left)
    decided |= {e.name: decide(wish, e) for e in others}
    left = tolerance - sum(e.cost or 0.0 for e in decided.values() if not e.on)
    plan = _of_relief(look, wish, decided, costs, left)
    if wish.base != "all" and _known_exactly(look, plan):
        plan = replace(plan, closed_form=True)
    return replace(plan, mode=job.config.effects.mode, tolerance=tolerance)


def simulated(job: Job) -> EffectsPlan:
    """Everything that the material calls for, without looking at costs: the plan of reference pictures."""
    wish = EffectsRequest.parse(job.config.effects.mode)
    look = _look(job, False)
    flat = job.grid.displacement_range == 0.0
    effects = [*_surface(look), _normal(look, None), _opacity(look, None), _fibers()]
    effects += [Effect(name, not flat, "flat" if flat else "a relief") for name in OF_RELIEF]
    effects.append(Effect("mis", True, "reference"))
    decided = _consistent({e.name: decide(wish, e) for e in effects}, wish)
    plan = _assemble(job, decided, job.config.transport.max_depth)
    return replace(plan, mode=job.config.effects.mode)


def _look(job: Job, pilots: bool) -> _Look:
    material = job.material
    base = np.asarray(material.base_color, np.float64)
    own = material.bsdf is not None
    albedo = np.ones((1, 1, 3)) if own else base.reshape(*(base.shape[:-1] or (1, 1)), 3)
    return _Look(
        job,
        albedo,
        material.is_lambert and material.clearcoat is None and material.sheen is None,
        own,
        pilots,
    )


def _relief(look: _Look) -> ReliefBounds | None:
    """Costs of the relief's effects and the normal map for a Lambert surface; None where there are none."""
    job = look.job
    nothing = job.grid.displacement_range == 0.0 and job.residual is None
    if nothing or not look.lambert or not look.albedo.any() or not look.pilots:
        return None
    residual = job.residual[0] if job.residual is not None else None
    kernel = LightKernel(job.config.light.width)
    queries = pilot_queries(job, POINTS)
    omega_i, omega_o = queries.omega_i.astype(np.float64), queries.omega_o.astype(np.float64)
    return relief_bounds(job.grid, omega_i, omega_o, kernel, look.albedo, residual, _through(look))


def _affordable(effects: list[Effect], tolerance: float) -> list[Effect]:
    """Effects that are on are switched off, the cheapest first, as long as their costs fit the tolerance."""
    out = {e.name: e for e in effects}
    for e in sorted((e for e in effects if e.on and e.cost is not None), key=lambda e: e.cost or 0.0):
        cost = e.cost or 0.0
        if cost > tolerance:
            break
        out[e.name] = replace(e, on=False)
        tolerance -= cost
    return list(out.values())


def _surface(look: _Look, questioned: Sequence[str] = ()) -> list[Effect]:
    """Specular lobe, metal, coat, sheen; `questioned` are measured where they are faint."""
    material = look.job.material
    if look.own_bsdf:
        reason = f"the material's own BSDF '{(material.bsdf or {})['type']}', not analyzed"
        on = Effect("specular", True, reason, present=False)
        others = ("metallic", "coat", "sheen")
        return [on, *(Effect(n, False, reason, 0.0, "exact", False) for n in others)]
    strengths = _strengths(material)
    words = {
        "specular": ("F0 up to {:.2g} %", "specular is 0 everywhere", 0.08 * 100.0),
        "metallic": ("metallic up to {:.2g}", "no metal anywhere", 1.0),
        "coat": ("covers up to {:.2g} %", "none is given", 100.0),
        "sheen": ("weight up to {:.2g}", "none is given", 1.0),
    }
    out = []
    for name, (text, absent, unit) in words.items():
        strength = strengths[name]
        if strength > 0.0:
            faint = name in questioned and strength * LAYERS[name] < FAINT
            cost = _faint_cost(look, name, strength * LAYERS[name]) if faint else None
            out.append(Effect(name, True, text.format(strength * unit), cost, "pilot" if faint else "asked"))
        else:
            if name == "specular" and material.specular is None:
                absent = "Lambert: no roughness, metallic or specular is given"
            out.append(Effect(name, False, absent, 0.0, "exact", False))
    return out


def _strengths(material: Material) -> dict[str, float]:
    """Largest value of each of the surface's terms."""
    sheen = 0.0 if material.sheen is None else float(np.max(material.sheen))
    if material.sheen_color is not None:
        sheen *= float(np.max(material.sheen_color))

    def largest(share: Share) -> float:
        return 0.0 if share is None else float(np.max(share))

    return {
        "specular": largest(material.specular),
        "metallic": largest(material.metallic),
        "coat": largest(material.clearcoat),
        "sheen": sheen,
    }


def _faint_cost(look: _Look, name: str, strength: float) -> float | None:
    """Cost of leaving out a faint layer: noise would hide it, so it is measured at full strength, of which
    the light that it changes is a share."""
    if not look.pilots:
        return None
    material = look.job.material
    scaled: dict[str, Any] = {name: np.asarray(getattr(material, name)) / strength}
    full = replace(material, **scaled)
    job = type(look.job).of(look.job.config, full)
    plan = simulated(job)
    return FAINT_CAUTION * strength * Pilot(job, plan).changed(without(plan, name)).bound()


def _normal(look: _Look, costs: ReliefBounds | None) -> Effect:
    job = look.job
    if job.residual is None:
        reason = "no map" if job.material.normal is None else "off in the configuration"
        if look.own_bsdf:
            reason = "the material has a BSDF of its own"
        return Effect("normal", False, reason, 0.0, "exact", False)
    slopes, share = job.residual
    rms = float(np.sqrt(np.mean(np.sum(slopes**2, axis=-1))))
    reason = f"adds slopes of {np.degrees(np.arctan(rms)):.2g}° (RMS)"
    if job.config.effects.normal == "residual" and job.grid.displacement_range > 0:
        reason += f"; of the relief's own, {100.0 * share:.0f} % are in the map and count once"
    if rms == 0.0:
        return Effect("normal", False, reason, 0.0, "exact")
    return Effect("normal", True, reason, costs.normal if costs else None, "pilot")


def _opacity(look: _Look, costs: ReliefBounds | None) -> Effect:
    through = _through(look)
    if through is None:
        opacity = look.job.material.opacity
        reason = "no map" if opacity is None else "own BSDF" if look.own_bsdf else "opaque everywhere"
        return Effect("opacity", False, reason, 0.0, "exact", False)
    reason = f"{100.0 * through.mean():.2g} % of the rays that meet the surface pass"
    if not look.lambert:
        return Effect("opacity", True, reason)
    if look.job.grid.displacement_range > 0.0:
        return Effect("opacity", True, reason, costs.opacity if costs else None, "pilot")
    # A plane's M is its color, less what passes.
    rows, columns = (max(a, b) for a, b in zip(through.shape, look.albedo.shape[:2], strict=True))
    passed = np.asarray(resample(through, rows, columns), np.float64)[..., None]
    color = np.asarray(resample(look.albedo, rows, columns), np.float64)
    mean = float(np.mean((1.0 - passed) * color))
    cost = float(np.sqrt(np.mean((passed * color) ** 2))) / mean if mean > 0 else None
    return Effect("opacity", True, reason, cost, "bound")


def _through(look: _Look) -> NDArray[np.float64] | None:
    """(h, w) share of the rays that pass; None where all is opaque."""
    opacity = look.job.material.opacity
    if opacity is None or look.own_bsdf or np.all(np.asarray(opacity) == 1.0):
        return None
    return 1.0 - np.atleast_2d(np.asarray(opacity, np.float64))


def _fibers() -> Effect:
    return Effect("fibers", False, "a height field, no fibers", 0.0, "exact", False)


def _of_relief(
    look: _Look, wish: EffectsRequest, decided: dict[str, Effect], costs: ReliefBounds | None, left: float
) -> EffectsPlan:
    """Effects of the relief and the sampling of light, given the surface's."""
    job = look.job
    cap = job.config.transport.max_depth
    decided["mis"] = decide(wish, _mis(look))
    black = not look.albedo.any() and look.lambert and not decided["opacity"].on
    if job.grid.displacement_range == 0.0 or black:
        reason = "flat" if job.grid.displacement_range == 0.0 else "black: nothing is reflected"
        for name in OF_RELIEF:
            decided[name] = decide(wish, Effect(name, False, reason, 0.0, "exact"))
        return _assemble(job, _consistent(decided, wish), cap)
    shadowing = _shadowing(look, costs)
    masking = Effect(
        "masking",
        True,
        f"a relief {100.0 * job.grid.displacement_range:.2g} % of the tile's width deep",
        costs.masking if costs else None,
        "pilot",
    )
    bounces = _bounce_bound(look) if costs is not None and costs.masking <= left else 0.0
    if costs is not None and costs.masking + bounces <= left:
        # Without the displaced tile its other effects go too; their costs are in the sum.
        masking = replace(masking, on=False, cost=costs.masking + bounces)
        for name in OF_RELIEF[1:]:
            decided[name] = decide(wish, Effect(name, False, "no displaced tile", 0.0, "pilot"))
        decided["masking"] = decide(wish, masking)
        return _assemble(job, _consistent(decided, wish), cap)
    decided["masking"] = decide(wish, masking)
    if shadowing.cost is not None and shadowing.cost <= left / 2:
        left -= shadowing.cost
        shadowing = replace(shadowing, on=False)
    decided["shadowing"] = decide(wish, shadowing)
    decided["neighbors"] = decide(wish, _neighbors(look))
    decided["interreflection"] = Effect("interreflection", True, "not looked at")
    decided["interreflection"], cap, cost = _interreflection(look, wish, decided, left)
    return _assemble(job, _consistent(decided, wish), cap, cost)


def _shadowing(look: _Look, costs: ReliefBounds | None) -> Effect:
    lowest = look.lowest_light
    if lowest > 0 and look.steepest <= np.tan(lowest):
        reason = f"slopes up to {_degrees(look.steepest)}, light no lower than {_degrees(np.tan(lowest))}"
        return Effect("shadowing", True, reason, look.below_lowest, "bound")
    low = "the horizon" if lowest <= 0 else _degrees(np.tan(lowest))
    reason = f"slopes up to {_degrees(look.steepest)}, light down to {low}"
    return Effect("shadowing", True, reason, costs.shadowing if costs else None, "pilot")


def _mis(look: _Look) -> Effect:
    """Whether sampling the surface finds light that next-event estimation finds only with high variance."""
    job = look.job
    width = np.radians(job.config.light.width)
    if width == 0.0:
        return Effect("mis", False, "a delta light cannot be hit", 0.0, "exact")
    if look.own_bsdf:
        return Effect("mis", True, "the material's own BSDF, not analyzed")
    if look.lambert:
        if job.config.light.width <= 20.0:
            reason = f"Lambert under a light of {job.config.light.width:g}°: sampling the light is best"
            return Effect("mis", False, reason, 0.0, "exact")
        return Effect("mis", True, "a wide light")
    material = job.material
    lobes = [2.0] if material.is_lambert else [2.0 * float(np.min(np.asarray(material.roughness))) ** 2]
    if material.clearcoat is not None:
        lobes.append(2.0 * float(np.min(np.asarray(material.clearcoat_roughness))) ** 2)
    if material.sheen is not None:
        # Fibers stand within √α of upright.
        lobes.append(float(np.min(np.asarray(material.sheen_roughness))))
    text = f"narrowest lobe {np.degrees(min(lobes)):.2g}°, light {job.config.light.width:g}°"
    if min(lobes) >= WIDER * width:
        return Effect("mis", False, f"{text}: sampling the light alone finds it as well", 0.0, "exact")
    return Effect("mis", True, text)


def _degrees(slope: float) -> str:
    angle = float(np.degrees(np.arctan(slope)))
    return f"{angle:.0f}°" if angle >= 10.0 else f"{angle:.1g}°"


def _bounce_bound(look: _Look) -> float:
    """Interreflection on a gentle relief, at most: facets of slope s see others only within 2·atan(s) of
    their planes, a share sin² of their cosine-weighted view; no facet is lit by more than 1/E, E being the
    irradiance of a lobe of unit strength on the plane; and what is bright may be little of the tile, so that
    the root mean square is more than the mean."""
    job, albedo = look.job, look.albedo
    brightest = float(albedo.max())
    share = brightest * np.sin(min(2.0 * np.arctan(look.steepest), 0.5 * np.pi)) ** 2
    low = job.config.queries.min_cos
    direction = np.array([[np.sqrt(1.0 - low * low), 0.0, low]])
    strongest = 1.0 / float(LightKernel(job.config.light.width).irradiance(direction)[0])
    uneven = float(np.sqrt(np.mean(albedo**2))) / max(float(np.mean(albedo)), 1e-12)
    return float(uneven * strongest * share / max(1.0 - share, 1e-12))


def _interreflection(
    look: _Look, wish: EffectsRequest, decided: dict[str, Effect], left: float
) -> tuple[Effect, int, float]:
    """Interreflection, its cap and the cap's cost, by a pilot with and without them on the same random
    numbers."""
    asked = look.job.config.transport.max_depth
    effect = decided["interreflection"]
    if asked == 1:
        return decide(wish, Effect("interreflection", False, "max_depth 1", None)), 1, 0.0
    if "interreflection" in wish.forced or wish.base != "auto" or not decided["masking"].on:
        effect = decide(wish, replace(effect, reason="a relief"))
        return effect, asked, 0.0
    most = _bounce_bound(look) if look.lambert else np.inf
    reason = "light from facet to facet"
    if most <= left:
        reason = f"{reason}, of which slopes up to {_degrees(look.steepest)} let little pass"
        return Effect("interreflection", False, reason, most, "bound"), 1, 0.0
    if not look.pilots:
        return replace(effect, reason="a relief; the run is too small for a pilot"), asked, 0.0
    pilot = Pilot(look.job, _assemble(look.job, _consistent(dict(decided), wish), asked))
    change = pilot.limited(1)
    cost, upper = change.cost, change.bound(most)
    if upper <= left:
        return Effect("interreflection", False, reason, upper, "pilot"), 1, 0.0
    found = Effect("interreflection", True, reason, cost, "pilot")
    if asked:
        return found, asked, 0.0
    # Every further interaction keeps about so much of the light: caps that cannot do are not tried.
    brightest = float(look.albedo.max())
    for cap in range(2, DEEPEST_CAP + 1):
        if cost * brightest ** (cap - 1) > 2.0 * left:
            continue
        upper = pilot.limited(cap).bound()
        if upper <= left:
            reason += (
                f"; paths end after {cap} interactions, more would bring less than {100.0 * upper:.1g} %"
            )
            return replace(found, reason=reason), cap, upper
    return replace(found, reason=f"{reason}; no limit, Russian roulette ends paths"), 0, 0.0


def _neighbors(look: _Look) -> Effect:
    """How far view and light rays move sideways within the relief. The tile repeats by construction, at no
    cost: nothing to switch."""
    job = look.job
    view = float(np.arcsin(job.config.queries.min_cos))
    lowest = min(view, look.lowest_light)
    if lowest > 0:
        tiles = job.grid.displacement_range / np.tan(lowest) / min(1.0, job.grid.aspect)
        reason = f"view and light rays cross up to {tiles:.2g} tiles; repeating the tile costs nothing"
    else:
        reason = "light from the horizon crosses any number of tiles; repeating the tile costs nothing"
    return Effect("neighbors", True, reason, present=False)


def _consistent(decided: dict[str, Effect], wish: EffectsRequest) -> dict[str, Effect]:
    """What depends on an effect goes with it."""

    def off(name: str, because: str) -> None:
        if decided[name].on:
            if wish.forced.get(name):
                raise UsageError(f"'{EFFECTS[name]}' needs '{because}'", where=f"--effects +{name}")
            decided[name] = replace(decided[name], on=False, reason=f"needs {because}")

    if not decided["masking"].on:
        for name in OF_RELIEF[1:]:
            off(name, EFFECTS["masking"])
    return decided


def without(plan: EffectsPlan, name: str) -> EffectsPlan:
    """The plan without an effect and without what needs it."""
    wish = EffectsRequest("auto", {name: False})
    decided = _consistent({e.name: decide(wish, e) for e in plan.effects}, wish)
    return replace(plan, effects=tuple(decided.values()))


def _assemble(job: Job, decided: dict[str, Effect], cap: int, cost: float = 0.0) -> EffectsPlan:
    effects = tuple(decided[name] for name in EFFECTS)
    return EffectsPlan(effects, cap, cost, job.config.transport.roulette_depth)


def _known_exactly(look: _Look, plan: EffectsPlan) -> bool:
    """A plane of one Lambert color, or black: M follows without tracing."""
    if any(plan.on(n) for n in ("specular", "metallic", "coat", "sheen", "opacity")) or look.own_bsdf:
        return False
    base = np.asarray(look.job.material.base_color)
    if not base.any():
        return True
    one = bool(np.all(base == base.reshape(-1, 3)[0]))
    return (
        one and look.job.grid.displacement_range == 0.0 and not plan.on("masking") and not plan.on("normal")
    )
